"""Machine code of the kernel: packed arguments, compiled entries and batches of flights."""
