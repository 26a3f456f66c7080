"""Files that lie in the sandbox beside the submission.  They import numpy and the standard library only."""
