"""Discretisation errors that travel with a result: measured on the scene itself, else from a model over anatomies."""
