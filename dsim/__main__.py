"""`python -m dsim`: the command, with the Python that is asked, wherever its scripts lie."""

from dsim.cli import main

if __name__ == "__main__":
    main()
