"""Pioneer robots with ARCOS or P2OS firmware: protocol, driver and emulator."""
