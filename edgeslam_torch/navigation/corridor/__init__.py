"""Following a corridor: the task, the way it has led so far, and what leads on from where the drone is."""
