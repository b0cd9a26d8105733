"""Edge points: their depth by epipolar search, those of keyframes, and those of the newest picture."""
