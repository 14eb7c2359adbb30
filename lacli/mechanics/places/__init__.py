"""Where runs happen: in processes side by side on this machine, or on the workers of a Dask cluster."""
