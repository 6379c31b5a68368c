//! V_e from one image (section 3.3.1, Fig. 4).
