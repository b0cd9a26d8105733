"""A Tello emulator on loopback with the real protocol: commands, 10 Hz state, H.264 video of a simulated room."""
