"""Batches: processes, threads, Dask or Ray; folders that a stopped run continues; progress."""
