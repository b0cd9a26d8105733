"""Edge points: depth by epipolar search, edges of keyframes, and edges of the newest image."""
