"""Scenarios, one YAML file each."""
