"""How many threads work on a product of matrices."""

from __future__ import annotations

from threadpoolctl import threadpool_limits


def one_thread() -> threadpool_limits:
    """Keep products of matrices to one thread while this context is open.

    Shared among two, a product is summed in another order: the bits of a result would depend on the machine's cores,
    which `--threads` does not tell BLAS of. And of small matrices two threads wait for each other most of the time.
    """
    return threadpool_limits(limits=1, user_api="blas")
