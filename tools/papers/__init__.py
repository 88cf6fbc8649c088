"""One file per paper: its experiment, its baselines, its tables."""
