//! A robot in a room.
