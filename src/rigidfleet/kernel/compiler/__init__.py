"""Compilation of the kernel with Numba: decorators, named tuples by address, SIMD values and the cache."""
