"""ROS bags and MCAP files as recordings, without ROS."""
