"""Projection models, one a file; a file's name is the model's, with _ for -."""
