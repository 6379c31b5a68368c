//! The simulated UR5 controller: RTDE, URScript, dashboard.
