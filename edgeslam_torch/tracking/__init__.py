"""Stage 2: the pose of every frame against the local map; initialisation and relocalisation."""
