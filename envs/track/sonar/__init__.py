"""Multi-target bearing tracking with a passive sonar: `SonarTracking-v0`."""
