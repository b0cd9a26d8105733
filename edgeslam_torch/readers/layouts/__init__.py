"""One module a data set: how its folder is recognised, and where its images, clock and camera are."""
