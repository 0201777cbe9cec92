"""Numba's side of the kernel: the decorators, named tuples by address, SIMD values and the cache."""
