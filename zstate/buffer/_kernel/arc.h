/* Arcs: the steps of a path between two samples, applied to many points at once.
 *
 * Between two samples a step turns about a fixed axis at a constant rate, and moves along a line at
 * a constant velocity: joints are interpolated linearly, poses by lerp and slerp. Its rotation is
 * the quaternion middle * cos(angle) + normal * sin(angle), of two unit quaternions at right angles
 * and an angle that is linear in time, zero halfway between the samples. All trigonometry of the
 * samples is done once, and the loops over points have neither branches nor calls. */

typedef struct {
    double middle[4], normal[4];
    double angle, rate; /* the angle of the quaternion, half that of the turn [rad], [rad/ns] */
    double position[3], velocity[3]; /* [m], [m/ns] */
    bool is_wide;                    /* angles exceed NARROW */
} Arc;

/* Points and their time since that of the arcs [ns]. */
#define CHUNK 64

typedef struct {
    double since[CHUNK], x[CHUNK], y[CHUNK], z[CHUNK];
    Py_ssize_t count;
} Chunk;

/* The rows of one track around an instant; `into` is the time since the first [ns]. */
typedef struct {
    const double *a;
    const double *b;
    double into;
    double period;
} Interval;

static inline void
multiplied(const double a[4], const double b[4], double out[4])
{
    Pose product = compose((Pose){0.0, 0.0, 0.0, a[0], a[1], a[2], a[3]},
                           (Pose){0.0, 0.0, 0.0, b[0], b[1], b[2], b[3]});
    const double q[4] = {product.qx, product.qy, product.qz, product.qw};
    memcpy(out, q, sizeof(q));
}

/* The motion from `first` to `last` in one period. */
static void
arc_move(Arc *arc, const double first[3], const double last[3], const Interval *now)
{
    for (int k = 0; k < 3; k++) {
        arc->velocity[k] = (last[k] - first[k]) / now->period;
        arc->position[k] = first[k] + arc->velocity[k] * now->into;
    }
}

/* Angles of -turn / 2 to turn / 2 in one period. */
static void
arc_turn(Arc *arc, double turn, const Interval *now)
{
    arc->rate = turn / now->period;
    arc->angle = turn * (now->into / now->period - 0.5);
}

/* The turn q_cos * cos(h) + q_sin * sin(h), from h = half to half + turn. */
static void
arc_joint_turn(Arc *arc, const double q_cos[4], const double q_sin[4], double half, double turn,
               const Interval *now)
{
    double c = cos(half + 0.5 * turn), s = sin(half + 0.5 * turn);
    for (int k = 0; k < 4; k++) {
        arc->middle[k] = q_cos[k] * c + q_sin[k] * s;
        arc->normal[k] = q_sin[k] * c - q_cos[k] * s;
    }
    arc_turn(arc, turn, now);
}

static double
joint_difference(const Step *step, double a, double b)
{
    return step->is_angle ? angle_difference(a, b) : b - a;
}

static void
arc_of_revolute(Arc *arc, const Step *step, const Interval *now)
{
    double a = now->a[step->column], b = now->b[step->column];
    double half = 0.5 * (step->scale * a + step->shift);
    double turn = 0.5 * step->scale * joint_difference(step, a, b);
    arc_joint_turn(arc, step->q_cos, step->q_sin, half, turn, now);
    memcpy(arc->position, step->t0, sizeof(arc->position));
}

static void
arc_of_prismatic(Arc *arc, const Step *step, const Interval *now)
{
    double a = now->a[step->column], b = now->b[step->column];
    double from = step->scale * a + step->shift;
    double to = from + step->scale * joint_difference(step, a, b), first[3], last[3];
    for (int k = 0; k < 3; k++) {
        first[k] = step->t0[k] + step->t1[k] * from;
        last[k] = step->t0[k] + step->t1[k] * to;
    }
    arc_move(arc, first, last, now);
    memcpy(arc->middle, step->q_cos, sizeof(arc->middle));
}

/* The motion of a point of the frame `origin`. */
static void
arc_move_in(Arc *arc, const Pose *origin, const double first[3], const double last[3],
            const Interval *now)
{
    const double q[4] = {origin->qx, origin->qy, origin->qz, origin->qw};
    double from[3] = {origin->x, origin->y, origin->z}, to[3] = {origin->x, origin->y, origin->z};
    add_rotated(from, q, first);
    add_rotated(to, q, last);
    arc_move(arc, from, to, now);
}

static void
arc_of_planar(Arc *arc, const Step *step, const Interval *now)
{
    const double *a = now->a + step->column, *b = now->b + step->column;
    const double first[3] = {a[0], a[1], 0.0}, last[3] = {b[0], b[1], 0.0};
    const double along_w[4] = {0.0, 0.0, 0.0, 1.0}, along_z[4] = {0.0, 0.0, 1.0, 0.0};
    const double q[4] = {step->origin.qx, step->origin.qy, step->origin.qz, step->origin.qw};
    double q_cos[4], q_sin[4];
    multiplied(q, along_w, q_cos);
    multiplied(q, along_z, q_sin);
    arc_joint_turn(arc, q_cos, q_sin, 0.5 * a[2], 0.5 * angle_difference(a[2], b[2]), now);
    arc_move_in(arc, &step->origin, first, last, now);
}

/* Slerp: from the middle of both quaternions, along their difference. */
static void
arc_of_pose(Arc *arc, const Step *step, const Interval *now)
{
    const double *a = now->a + step->column, *b = now->b + step->column;
    const double q[4] = {step->origin.qx, step->origin.qy, step->origin.qz, step->origin.qw};
    double dot = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6];
    double sign = dot < 0.0 ? -1.0 : 1.0, less = 0.0, more = 0.0, middle[4], normal[4];
    for (int k = 0; k < 4; k++) {
        middle[k] = a[3 + k] + sign * b[3 + k];
        normal[k] = sign * b[3 + k] - a[3 + k];
        more += middle[k] * middle[k];
        less += normal[k] * normal[k];
    }
    less = sqrt(less);
    more = sqrt(more);
    for (int k = 0; k < 4; k++) {
        middle[k] /= more;
        normal[k] = less > 0.0 ? normal[k] / less : 0.0;
    }
    multiplied(q, middle, arc->middle);
    multiplied(q, normal, arc->normal);
    arc_turn(arc, 2.0 * atan2(less, more), now);
    arc_move_in(arc, &step->origin, a, b, now);
}

static void
arc_of_static(Arc *arc, const Pose *origin)
{
    const double t[3] = {origin->x, origin->y, origin->z};
    const double q[4] = {origin->qx, origin->qy, origin->qz, origin->qw};
    memcpy(arc->position, t, sizeof(t));
    memcpy(arc->middle, q, sizeof(q));
}

/* Sine and cosine of smaller angles are sums of a few terms: the next ones are below 1e-17. */
#define NARROW 0.125

static void
arc_of(Arc *arc, const Step *step, const Interval *intervals)
{
    const Interval *now = step->kind == STEP_STATIC ? NULL : &intervals[step->use];
    memset(arc, 0, sizeof(*arc));
    switch (step->kind) {
    case STEP_REVOLUTE:
        arc_of_revolute(arc, step, now);
        break;
    case STEP_PRISMATIC:
        arc_of_prismatic(arc, step, now);
        break;
    case STEP_PLANAR:
        arc_of_planar(arc, step, now);
        break;
    case STEP_POSE:
        arc_of_pose(arc, step, now);
        break;
    default:
        arc_of_static(arc, &step->origin);
    }
    arc->is_wide = now != NULL && !(fabs(0.5 * arc->rate * now->period) <= NARROW);
}

static void
arc_sines(const Arc *arc, const Chunk *chunk, double *sines, double *cosines)
{
    for (Py_ssize_t i = 0; i < chunk->count; i++) {
        double angle = arc->angle + arc->rate * chunk->since[i], n = angle * angle;
        double s = 1.0 - n * (1.0 / 72.0);
        double c = 1.0 - n * (1.0 / 90.0);
        s = 1.0 - n * (1.0 / 42.0) * s;
        c = 1.0 - n * (1.0 / 56.0) * c;
        s = 1.0 - n * (1.0 / 20.0) * s;
        c = 1.0 - n * (1.0 / 30.0) * c;
        s = 1.0 - n * (1.0 / 6.0) * s;
        c = 1.0 - n * (1.0 / 12.0) * c;
        sines[i] = angle * s;
        cosines[i] = 1.0 - n * 0.5 * c;
    }
}

static void
arc_wide_sines(const Arc *arc, const Chunk *chunk, double *sines, double *cosines)
{
    for (Py_ssize_t i = 0; i < chunk->count; i++) {
        double angle = arc->angle + arc->rate * chunk->since[i];
        sines[i] = sin(angle);
        cosines[i] = cos(angle);
    }
}

/* Moves the points from the lower frame of the step to the upper one. */
static void
arc_apply(const Arc *arc, Chunk *chunk, const double *sines, const double *cosines)
{
    for (Py_ssize_t i = 0; i < chunk->count; i++) {
        double c = cosines[i], s = sines[i], since = chunk->since[i], q[4], placed[3];
        const double point[3] = {chunk->x[i], chunk->y[i], chunk->z[i]};
        for (int k = 0; k < 4; k++)
            q[k] = arc->middle[k] * c + arc->normal[k] * s;
        for (int k = 0; k < 3; k++)
            placed[k] = arc->position[k] + arc->velocity[k] * since;
        add_rotated(placed, q, point);
        chunk->x[i] = placed[0];
        chunk->y[i] = placed[1];
        chunk->z[i] = placed[2];
    }
}

/* From the upper frame to the lower one. */
static void
arc_apply_inverse(const Arc *arc, Chunk *chunk, const double *sines, const double *cosines)
{
    for (Py_ssize_t i = 0; i < chunk->count; i++) {
        double c = cosines[i], s = sines[i], since = chunk->since[i], q[4], placed[3] = {0.0};
        double point[3] = {chunk->x[i], chunk->y[i], chunk->z[i]};
        for (int k = 0; k < 4; k++)
            q[k] = (k < 3 ? -1.0 : 1.0) * (arc->middle[k] * c + arc->normal[k] * s);
        for (int k = 0; k < 3; k++)
            point[k] -= arc->position[k] + arc->velocity[k] * since;
        add_rotated(placed, q, point);
        chunk->x[i] = placed[0];
        chunk->y[i] = placed[1];
        chunk->z[i] = placed[2];
    }
}

static void
arc_run(const Arc *arc, bool is_inverse, Chunk *chunk)
{
    double sines[CHUNK], cosines[CHUNK];
    if (arc->is_wide)
        arc_wide_sines(arc, chunk, sines, cosines);
    else
        arc_sines(arc, chunk, sines, cosines);
    if (is_inverse)
        arc_apply_inverse(arc, chunk, sines, cosines);
    else
        arc_apply(arc, chunk, sines, cosines);
}
