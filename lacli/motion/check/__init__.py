"""Simulated motion held against the tracked one."""
