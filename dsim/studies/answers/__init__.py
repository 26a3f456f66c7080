"""Reference problems with certified answers, as data for programs in any language.

document.py  what a document holds
programs.py  discrete programs: small scenes with every method, to be met to round-off
motions.py   continuous problems with a known motion and gradient, to be met as h falls
formulas.py  single derivatives in closed form that programs get wrong or find of no use
export.py    documents as JSON and NPZ in a directory, and the check of such a directory
"""
