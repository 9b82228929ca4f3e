//! Channels between the server and its robots.
