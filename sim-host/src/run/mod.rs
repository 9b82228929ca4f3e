//! What joins a source, agents, channels and the server into one run.
