"""Camera poses of a stationary camera in front of a turntable."""
