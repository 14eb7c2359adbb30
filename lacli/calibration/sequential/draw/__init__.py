"""Draws of the emulated posterior: chain, importance sampling, what was learnt from them."""
