"""A Tello on loopback that speaks the real protocol: commands, 10 Hz state, H.264 video of a simulated room."""
