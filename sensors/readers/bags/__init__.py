"""ROS bags: their clouds, packets, joints and poses."""
