"""Pictures of a run: plot page, frames with their features, video."""
