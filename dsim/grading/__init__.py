"""Grading student code that nobody trusts: values cross a pipe, grades are made on this side of it.

inside/       the only files of ours that the sandbox sees: the protocol and the worker
sandbox.py    the sandbox itself, and the proof that it holds
student.py    a submission as checks see it: `student.call("function", *values)`
compare.py    comparisons that look at shape, type and finiteness first
"""
