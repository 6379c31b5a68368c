//! From V_e to ml: calibration and the estimate of the volume poured.
