"""One thread a worker: two workers whose linear algebra takes two threads each only get in each other's way."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
