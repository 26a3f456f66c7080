"""What runs inside Gradescope's container: one submission, from /autograder/submission to /autograder/results.

`python -m dsim.grading.there /autograder` is called by run_autograder, beside this file; `dsim assignments gradescope`
puts both into the zip.
"""
