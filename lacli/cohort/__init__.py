"""Many patients: their table, statistics over them, comparison of models."""
