"""What surfaces look like: seeded materials and pictures."""
