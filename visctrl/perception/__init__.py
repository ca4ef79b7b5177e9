"""Perception: from frames to the same features seen in three views."""

PERCEPTION = {
    "klt": "klt:Klt",
    "sift": "sift:Sift",
    "features": "features:IdentifiedFeatures",
}
