"""A DJI Tello: client (`tello.Tello`), video, state messages, and an emulator."""
