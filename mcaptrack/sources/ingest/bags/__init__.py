"""Recordings of robots: ROS 1 bags, rosbag2 folders and databases, MCAP files."""
