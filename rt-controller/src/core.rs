//! What decides: a pure step function.
