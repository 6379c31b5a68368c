//! Container physics: the simulators "a" (the paper's) and "b" (physical).
