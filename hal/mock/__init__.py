"""The mock backend: an exact unicycle that sees identified features."""
