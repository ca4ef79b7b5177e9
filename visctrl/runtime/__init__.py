"""What runs a session: registry, plan, scheduler, safety, recorder."""
