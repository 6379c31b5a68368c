//! The robot link: RTDE client and the program that runs on the robot.
