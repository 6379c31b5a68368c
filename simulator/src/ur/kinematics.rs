//! Where the UR5's flange is: forward kinematics.
//!
//! Pure. Runs on the controller's thread; does not allocate and cannot fail.

/// The Denavit-Hartenberg parameters a (m), d (m) and alpha (rad) of each joint, base to tool, as UR publishes them for the UR5.
const DH: [(f64, f64, f64); 6] = [
    (0.0, 0.089159, std::f64::consts::FRAC_PI_2),
    (-0.425, 0.0, 0.0),
    (-0.39225, 0.0, 0.0),
    (0.0, 0.10915, std::f64::consts::FRAC_PI_2),
    (0.0, 0.09465, -std::f64::consts::FRAC_PI_2),
    (0.0, 0.0823, 0.0),
];

/// A transformation of 3 by 4 numbers, row by row: the rotation and, in the last column, the position in m.
type Transform = [[f64; 4]; 3];

fn times(a: &Transform, b: &Transform) -> Transform {
    std::array::from_fn(|r| std::array::from_fn(|c| (0..3).map(|k| a[r][k] * b[k][c]).sum::<f64>() + if c == 3 { a[r][3] } else { 0.0 }))
}

/// The coordinate systems of the base and after each joint, in the base's coordinates; the last is the flange.
fn transforms(q: &[f64; 6]) -> [Transform; 7] {
    let mut all = [[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]; 7];
    for (i, (a, d, alpha)) in DH.iter().enumerate() {
        let (st, ct) = q[i].sin_cos();
        let (sa, ca) = alpha.sin_cos();
        let link = [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0.0, sa, ca, *d]];
        all[i + 1] = times(&all[i], &link);
    }
    all
}

/// The flange's pose at the joint angles `q` (rad): x, y, z in m and the rotation vector in rad.
pub fn pose(q: &[f64; 6]) -> [f64; 6] {
    let t = transforms(q)[6];
    let axis = [t[2][1] - t[1][2], t[0][2] - t[2][0], t[1][0] - t[0][1]];
    let sine = axis.iter().map(|v| v * v).sum::<f64>().sqrt() / 2.0;
    let cosine = (t[0][0] + t[1][1] + t[2][2] - 1.0) / 2.0;
    let angle = sine.atan2(cosine);
    let rotation = if sine > 1e-6 {
        axis.map(|v| v / (2.0 * sine) * angle)
    } else if cosine > 0.0 {
        [0.0; 3]
    } else {
        // The rotation is half a turn, so every column of R + 1 lies along the axis. The largest one is the most exact.
        let largest = (0..3).max_by(|a, b| t[*a][*a].total_cmp(&t[*b][*b])).unwrap_or(0);
        let mut column: [f64; 3] = std::array::from_fn(|r| t[r][largest]);
        column[largest] += 1.0;
        let length = column.iter().map(|v| v * v).sum::<f64>().sqrt();
        column.map(|v| v / length * angle)
    };
    [t[0][3], t[1][3], t[2][3], rotation[0], rotation[1], rotation[2]]
}

/// The flange's velocity (three in m/s, three in rad/s) at the joint angles `q` (rad) and speeds `qd` (rad/s).
pub fn speed(q: &[f64; 6], qd: &[f64; 6]) -> [f64; 6] {
    let all = transforms(q);
    let tool: [f64; 3] = std::array::from_fn(|r| all[6][r][3]);
    let mut sum = [0.0; 6];
    for (joint, rate) in all.iter().zip(qd) {
        let axis: [f64; 3] = std::array::from_fn(|r| joint[r][2]);
        let arm: [f64; 3] = std::array::from_fn(|r| tool[r] - joint[r][3]);
        let turned = [axis[1] * arm[2] - axis[2] * arm[1], axis[2] * arm[0] - axis[0] * arm[2], axis[0] * arm[1] - axis[1] * arm[0]];
        for r in 0..3 {
            sum[r] += turned[r] * rate;
            sum[r + 3] += axis[r] * rate;
        }
    }
    sum
}
