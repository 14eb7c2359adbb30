"""One self-contained HTML page of a run, or of a patient's calibration: opens without a network."""
