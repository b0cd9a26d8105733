"""What was told and seen: the flight so far, the video's delay, the attitude of the map, and whether they agree."""
