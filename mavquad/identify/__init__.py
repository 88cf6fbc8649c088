"""From flight records to models with error bars."""
