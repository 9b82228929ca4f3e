//! Camera evidence, robot layers and the fused layer.
