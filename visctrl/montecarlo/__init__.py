"""Many runs of one experiment as one: every step is an array operation over all robots."""
