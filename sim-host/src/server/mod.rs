//! The camera server: a session for each robot.
