"""Many logs on the workers of a Dask cluster."""
