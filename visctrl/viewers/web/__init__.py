"""A page to watch a run in a browser, and to stop it."""
