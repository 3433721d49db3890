/* Lanes: the poses of a path at several instants at once. The products of one instant wait for each
 * other; those of several are computed beside each other. The operations on each number and their
 * order are those of pose_at, so that a pose is the same to the bit, whether alone or in a lane. */

#define LANES 8

typedef struct {
    double x[LANES], y[LANES], z[LANES], qx[LANES], qy[LANES], qz[LANES], qw[LANES];
} Poses;

static inline Pose
lane_of(const Poses *poses, int i)
{
    return (Pose){poses->x[i],  poses->y[i],  poses->z[i], poses->qx[i],
                  poses->qy[i], poses->qz[i], poses->qw[i]};
}

static inline void
set_lane(Poses *poses, int i, Pose pose)
{
    poses->x[i] = pose.x;
    poses->y[i] = pose.y;
    poses->z[i] = pose.z;
    poses->qx[i] = pose.qx;
    poses->qy[i] = pose.qy;
    poses->qz[i] = pose.qz;
    poses->qw[i] = pose.qw;
}

static void
compose_lanes(Poses *restrict a, const Poses *restrict b)
{
    for (int i = 0; i < LANES; i++)
        set_lane(a, i, compose(lane_of(a, i), lane_of(b, i)));
}

/* The brackets of lane i begin at nows[i * tracks]. */
static void
step_lanes(const Step *step, const Bracket *nows, Py_ssize_t tracks, Poses *restrict poses)
{
    double c[LANES], s[LANES];
    if (step->kind != STEP_REVOLUTE) {
        for (int i = 0; i < LANES; i++)
            set_lane(poses, i, step_pose(step, nows + i * tracks));
        return;
    }
    for (int i = 0; i < LANES; i++) {
        double half = 0.5 * joint_value(step, &nows[i * tracks + step->use]);
        c[i] = cos(half);
        s[i] = sin(half);
    }
    for (int i = 0; i < LANES; i++)
        set_lane(poses, i, turned_pose(step, c[i], s[i]));
}

static void
chain_lanes(const Step *steps, Py_ssize_t count, const Bracket *nows, Py_ssize_t tracks,
            Poses *poses)
{
    Poses next;
    for (int i = 0; count == 0 && i < LANES; i++)
        set_lane(poses, i, identity);
    for (Py_ssize_t n = 0; n < count; n++) {
        step_lanes(&steps[n], nows, tracks, n == 0 ? poses : &next);
        if (n > 0)
            compose_lanes(poses, &next);
    }
}
