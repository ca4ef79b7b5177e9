"""One HTML page of a run, made from its files."""
