"""A DJI Tello: the client that flies it (`tello.Tello`), its video, its state messages, and an emulator."""
