"""One BLAS thread in each test process: `make test` runs one for each of two cores, and the matrices are small.

A test of the calibration took 82 s with two threads in each of two processes, 12 s so.
"""

import scipy.linalg  # noqa: F401  Its BLAS has to be there to be held.
from threadpoolctl import threadpool_limits

threadpool_limits(1, user_api="blas")
