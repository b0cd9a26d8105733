"""One file a sensor: what it measures between two moments, its noise, and when it may be relied on."""
