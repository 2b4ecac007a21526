"""What this machine offers: its GPU, its cores, the cache of compiled kernels; and how a stage reports its progress."""
