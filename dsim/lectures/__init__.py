"""The course's lectures: MyST sources that are run, checked, written as notebooks and as a site.

folder.py     where they lie, and what each is called
notebook.py   reading, running, the student edition, the committed notebooks
rules.py      what every lecture must have, as checks
site.py       the HTML pages, which need no network
"""
