"""How the shading is compiled: to machine code that runs beside other threads."""

from __future__ import annotations

from numba import njit

# No NaN comes into the kernels (rays into the sky are sorted out first), so fastmath is safe.
# _nrt=False leaves out the counting of references to arrays: the kernels allocate nothing, and
# counting took nine tenths of their time, as every access to a field of the scene counts.
kernel = njit(cache=True, nogil=True, fastmath=True, error_model="numpy", _nrt=False)
"""For functions that are called from many places."""

inlined = njit(
    cache=True, nogil=True, fastmath=True, error_model="numpy", forceinline=True, _nrt=False
)
"""For functions with one caller or a small body: passing the scene costs more than they do."""
