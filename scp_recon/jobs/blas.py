"""Limit NumPy's and SciPy's linear algebra to one thread while this library works.

Matrices of the planner are small: several threads of BLAS wait for each other in busy loops, and a plan
of whole flights takes three times as long where another process works too.
"""

from __future__ import annotations

import os
from contextlib import ContextDecorator
from threading import Lock
from typing import Any

GIVEN = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables by which a user chooses the number of threads; the choice is kept."""


class OneThread(ContextDecorator):
    """Context, and decorator of a function, inside of which BLAS has one thread.

    The number of threads belongs to the whole process. The first thread that enters sets it, and the
    last one that leaves restores the user's number; in between others come and go.
    """

    def __init__(self) -> None:
        self._lock, self._inside = Lock(), 0
        self._limit: Any = None

    def __enter__(self) -> None:
        """Set the number, unless it is set."""
        with self._lock:
            if self._inside == 0 and not any(name in os.environ for name in GIVEN):
                import scipy.linalg  # noqa: F401 -- only libraries that are loaded are limited
                from threadpoolctl import threadpool_limits

                self._limit = threadpool_limits(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        """Restore the user's number after the last one."""
        with self._lock:
            self._inside -= 1
            if self._inside == 0 and self._limit is not None:
                from threadpoolctl import OpenBLASController

                # Only the thread that set the number of OpenBLAS could restore it otherwise.
                OpenBLASController.clear_controlling_thread(force=True)
                self._limit.restore_original_limits()
                OpenBLASController.clear_controlling_thread(force=True)
                self._limit = None


one_thread = OneThread()
"""Of this process."""
