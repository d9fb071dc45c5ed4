"""ROS bags, of ROS 1 and ROS 2: read by `ingest`, written by `export`."""
