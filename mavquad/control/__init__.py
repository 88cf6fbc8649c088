"""Controllers: from an estimate and a demand to a command."""
