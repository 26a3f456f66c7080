"""The page that `dsim verify` writes: what was checked, what came out, and the command that shows it again.

model.py     Section, Table, Picture, Page: plain data
html.py      Page -> one HTML file
terminal.py  Section -> a table of 80 columns, and progress
verify.py    run(jobs): build each section, print it, write the page
sections.py  jobs(full): the explicit list of sections
"""
