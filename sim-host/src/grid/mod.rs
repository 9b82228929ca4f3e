//! Occupancy grids, ROS map files and scores.
