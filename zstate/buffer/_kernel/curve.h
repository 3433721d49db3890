/* Curves: the pose of a path between two samples as polynomials of time, for many points at once.
 *
 * Between two samples joints and poses turn and move at constant rates, so each number of the
 * path's pose is a sum of sines and cosines of time, some of them times time itself. Its Chebyshev
 * series converges faster than any geometric one: while the steps turn by `a` in all [rad], term n
 * is about 2 (a / 4)^n / n! of the largest number (L. N. Trefethen, "Approximation Theory and
 * Approximation Practice", chapters 4 and 8). A curve interpolates the poses at eight Chebyshev
 * nodes. Its last terms bound those that it does not have, and a point costs the same for any
 * number of steps. */

#define TERMS 8

/* Turns above about 0.08 rad exceed this limit, and have to be halved. Below it the terms that a
 * curve does not have are less than 1e-16: term n + 2 is about a^2 / 1000 of term n. Turns that
 * cancel can be larger; what remains of them is then at most about twice the limit. */
#define LAST_TERMS 2e-13

typedef struct {
    double factors[7][TERMS]; /* of 1, x, ..., x^7 in each number of the pose */
    int64_t begin;            /* x is -1 there, and 1 at the end */
    double rate;              /* of x [1/ns] */
} Curve;

/* The first of two samples of a track, and the period between them [ns]. */
typedef struct {
    int64_t earlier;
    double period;
} Interval;

/* Points, and the x of their stamps. */
#define CHUNK 64

typedef struct {
    double at[CHUNK], x[CHUNK], y[CHUNK], z[CHUNK];
    Py_ssize_t count;
} Chunk;

/* cos((n + 1/2) pi / TERMS) */
static const double curve_nodes[TERMS] = {
    0.98078528040323044,  0.83146961230254524,  0.55557023301960222,  0.19509032201612827,
    -0.19509032201612827, -0.55557023301960222, -0.83146961230254524, -0.98078528040323044,
};

/* The Chebyshev polynomials as sums of powers of x. */
static const double chebyshev_powers[TERMS][TERMS] = {
    {1.0},
    {0.0, 1.0},
    {-1.0, 0.0, 2.0},
    {0.0, -3.0, 0.0, 4.0},
    {1.0, 0.0, -8.0, 0.0, 8.0},
    {0.0, 5.0, 0.0, -20.0, 0.0, 16.0},
    {-1.0, 0.0, 18.0, 0.0, -48.0, 0.0, 32.0},
    {0.0, -7.0, 0.0, 56.0, 0.0, -112.0, 0.0, 64.0},
};

/* The lengths of all steps, which bound the position of the pose and its rounding [m]. */
static double
path_reach(const Path *path, const Bracket *nows)
{
    double reach = 1.0;
    for (Py_ssize_t i = 0; i < path->to_target + path->to_source; i++) {
        Pose pose = step_pose(&path->steps[i], nows);
        reach += fabs(pose.x) + fabs(pose.y) + fabs(pose.z);
    }
    return reach;
}

/* Polynomial n at node k. */
static void
chebyshev_at_nodes(double polynomials[TERMS][TERMS])
{
    for (int k = 0; k < TERMS; k++) {
        polynomials[0][k] = 1.0;
        polynomials[1][k] = curve_nodes[k];
        for (int n = 2; n < TERMS; n++)
            polynomials[n][k] =
                2.0 * curve_nodes[k] * polynomials[n - 1][k] - polynomials[n - 2][k];
    }
}

/* The Chebyshev series of a number from its values at the nodes, as factors of powers of x. Returns
 * the size of the last two terms. */
static double
curve_fit(double polynomials[TERMS][TERMS], const double values[TERMS], double factors[TERMS])
{
    double last = 0.0;
    memset(factors, 0, TERMS * sizeof(double));
    for (int n = 0; n < TERMS; n++) {
        double term = 0.0;
        for (int k = 0; k < TERMS; k++)
            term += values[k] * polynomials[n][k];
        term *= (n == 0 ? 1.0 : 2.0) / TERMS;
        for (int j = 0; j <= n; j++)
            factors[j] += term * chebyshev_powers[n][j];
        last += n < TERMS - 2 ? 0.0 : fabs(term);
    }
    return last;
}

/* The curve from `begin` to `end`, which are between the samples in `nows`. Returns the size of its
 * last terms, of positions relative to the reach of the path; NaN if a number is not finite. */
static double
curve_of(Curve *curve, const Path *path, Bracket *nows, const Interval *intervals,
         Py_ssize_t tracks, int64_t begin, int64_t end)
{
    double polynomials[TERMS][TERMS], values[7][TERMS], last = 0.0;
    double length = (double)(end - begin);
    for (int n = 0; n < TERMS; n++) {
        for (Py_ssize_t i = 0; i < tracks; i++) {
            double into = (double)((uint64_t)begin - (uint64_t)intervals[i].earlier);
            nows[i].ratio = (into + 0.5 * (1.0 + curve_nodes[n]) * length) / intervals[i].period;
        }
        Pose pose = normalized(pose_at(path, nows));
        const double numbers[7] = {pose.x, pose.y, pose.z, pose.qx, pose.qy, pose.qz, pose.qw};
        for (int k = 0; k < 7; k++)
            values[k][n] = numbers[k];
    }
    chebyshev_at_nodes(polynomials);
    for (int k = 0; k < 3; k++)
        last += curve_fit(polynomials, values[k], curve->factors[k]);
    double reach = path_reach(path, nows);
    last = isfinite(reach) ? last / reach : Py_NAN;
    for (int k = 3; k < 7; k++)
        last += curve_fit(polynomials, values[k], curve->factors[k]);
    curve->begin = begin;
    curve->rate = 2.0 / length;
    return last;
}

/* Moves the points of a chunk by the poses of the curve. */
static void
curve_apply(const Curve *curve, Chunk *chunk)
{
    double pose[7][CHUNK];
    for (int k = 0; k < 7; k++) {
        const double *f = curve->factors[k];
        for (Py_ssize_t i = 0; i < chunk->count; i++) {
            double x = chunk->at[i], sum = f[6] + x * f[7];
            sum = f[4] + x * (f[5] + x * sum);
            sum = f[2] + x * (f[3] + x * sum);
            pose[k][i] = f[0] + x * (f[1] + x * sum);
        }
    }
    for (Py_ssize_t i = 0; i < chunk->count; i++) {
        double placed[3] = {pose[0][i], pose[1][i], pose[2][i]};
        const double q[4] = {pose[3][i], pose[4][i], pose[5][i], pose[6][i]};
        const double point[3] = {chunk->x[i], chunk->y[i], chunk->z[i]};
        add_rotated(placed, q, point);
        chunk->x[i] = placed[0];
        chunk->y[i] = placed[1];
        chunk->z[i] = placed[2];
    }
}
