/* Rigid motions: zstate/se3.py, in the same order of operations. */

typedef struct {
    double x, y, z, qx, qy, qz, qw;
} Pose;

static const Pose identity = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0};

/* p + R(q) t */
static inline void
add_rotated(double p[3], const double q[4], const double t[3])
{
    double x = q[0], y = q[1], z = q[2], w = q[3];
    double ux = 2.0 * (y * t[2] - z * t[1]);
    double uy = 2.0 * (z * t[0] - x * t[2]);
    double uz = 2.0 * (x * t[1] - y * t[0]);
    p[0] += t[0] + w * ux + y * uz - z * uy;
    p[1] += t[1] + w * uy + z * ux - x * uz;
    p[2] += t[2] + w * uz + x * uy - y * ux;
}

static inline Pose
compose(Pose a, Pose b)
{
    double p[3] = {a.x, a.y, a.z};
    const double q[4] = {a.qx, a.qy, a.qz, a.qw}, t[3] = {b.x, b.y, b.z};
    add_rotated(p, q, t);
    return (Pose){
        p[0],
        p[1],
        p[2],
        a.qw * b.qx + a.qx * b.qw + a.qy * b.qz - a.qz * b.qy,
        a.qw * b.qy - a.qx * b.qz + a.qy * b.qw + a.qz * b.qx,
        a.qw * b.qz + a.qx * b.qy - a.qy * b.qx + a.qz * b.qw,
        a.qw * b.qw - a.qx * b.qx - a.qy * b.qy - a.qz * b.qz,
    };
}

static inline Pose
invert(Pose a)
{
    double p[3] = {0.0, 0.0, 0.0};
    const double q[4] = {-a.qx, -a.qy, -a.qz, a.qw}, t[3] = {a.x, a.y, a.z};
    add_rotated(p, q, t);
    return (Pose){-p[0], -p[1], -p[2], q[0], q[1], q[2], q[3]};
}

static inline Pose
normalized(Pose a)
{
    double scale = 1.0 / sqrt(a.qx * a.qx + a.qy * a.qy + a.qz * a.qz + a.qw * a.qw);
    return (Pose){a.x, a.y, a.z, a.qx * scale, a.qy * scale, a.qz * scale, a.qw * scale};
}

static bool
is_finite(Pose p)
{
    /* x * 0 is 0 for finite x and NaN otherwise: no branch for each number. */
    double position = p.x * 0.0 + p.y * 0.0 + p.z * 0.0;
    return position + (p.qx * 0.0 + p.qy * 0.0 + p.qz * 0.0 + p.qw * 0.0) == 0.0;
}

/* sin(r * angle) / sin(angle), as a series in cos(angle) - 1 = -less / 2, where less is the squared
 * chord between two unit quaternions: D. Eberly, "A Fast and Accurate Algorithm for Computing
 * SLERP" (2011). Each factor is below 0.005 for less < SMALL_CHORD, so that eight leave nothing to
 * see in a double, and no trigonometry is needed between samples of usual rates. */
#define SMALL_CHORD 0.02

static inline double
slerp_weight(double r, double less)
{
    double rr = r * r, c = -0.5 * less;
    double sum = 1.0;
    sum = 1.0 + (rr - 64.0) * (c * (1.0 / 136.0)) * sum;
    sum = 1.0 + (rr - 49.0) * (c * (1.0 / 105.0)) * sum;
    sum = 1.0 + (rr - 36.0) * (c * (1.0 / 78.0)) * sum;
    sum = 1.0 + (rr - 25.0) * (c * (1.0 / 55.0)) * sum;
    sum = 1.0 + (rr - 16.0) * (c * (1.0 / 36.0)) * sum;
    sum = 1.0 + (rr - 9.0) * (c * (1.0 / 21.0)) * sum;
    sum = 1.0 + (rr - 4.0) * (c * (1.0 / 10.0)) * sum;
    sum = 1.0 + (rr - 1.0) * (c * (1.0 / 3.0)) * sum;
    return r * sum;
}

static void
slerp_weights(double r, double less, double more, double *wa, double *wb)
{
    if (less < SMALL_CHORD) {
        *wa = slerp_weight(1.0 - r, less);
        *wb = slerp_weight(r, less);
        return;
    }
    double angle = 2.0 * atan2(sqrt(less), sqrt(more));
    double sine = sin(angle);
    if (sine < 1e-300) {
        *wa = 1.0 - r;
        *wb = r;
        return;
    }
    *wa = sin((1.0 - r) * angle) / sine;
    *wb = sin(r * angle) / sine;
}

/* The pose of seven columns, between row a and row b. */
static Pose
interpolate_pose(const double *a, const double *b, double r)
{
    if (a == b)
        return (Pose){a[0], a[1], a[2], a[3], a[4], a[5], a[6]};
    double dot = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6];
    double sign = dot < 0.0 ? -1.0 : 1.0, less = 0.0, more = 0.0, wa, wb;
    for (int k = 3; k < 7; k++) {
        double other = sign * b[k];
        less += (other - a[k]) * (other - a[k]);
        more += (other + a[k]) * (other + a[k]);
    }
    slerp_weights(r, less, more, &wa, &wb);
    wb *= sign;
    return (Pose){
        a[0] + r * (b[0] - a[0]), a[1] + r * (b[1] - a[1]), a[2] + r * (b[2] - a[2]),
        wa * a[3] + wb * b[3],    wa * a[4] + wb * b[4],    wa * a[5] + wb * b[5],
        wa * a[6] + wb * b[6],
    };
}
