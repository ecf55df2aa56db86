"""How kernels of this backbone are compiled where numbers are known to be finite."""

from __future__ import annotations

from numba import njit

# Neither sums are reordered nor products contracted into them, as all of fastmath would: the last
# digits would hang on what is inlined, and that differs between code just compiled and the same
# code from the cache, so that the first run of an installation would differ from the second.
finite_kernel = njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz"})
