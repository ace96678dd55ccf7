"""Camera poses from a camera that stands still before a turntable."""
