/* Path.place: points moved by the poses at their own stamps, for zstate/buffer/path.py. */

/* (N, 3) of float or double, with any strides; each number may be at any address. */
typedef struct {
    const char *first;
    Py_ssize_t row;
    Py_ssize_t column;
    Py_ssize_t count;
    bool is_single;
} Points;

/* -1 and ValueError, or the error of the buffer, unless it holds points. */
static int
get_points(PyObject *object, Py_buffer *view, Points *points)
{
    if (PyObject_GetBuffer(object, view, PyBUF_STRIDED_RO | PyBUF_FORMAT) < 0)
        return -1;
    const char *format = view->format != NULL ? view->format : "B";
    if (format[0] == '=') /* of numbers that are not aligned */
        format++;
    bool is_single = strcmp(format, "f") == 0 && view->itemsize == sizeof(float);
    bool is_double = strcmp(format, "d") == 0 && view->itemsize == sizeof(double);
    if ((is_single || is_double) && view->ndim == 2 && view->shape[1] == 3) {
        *points =
            (Points){view->buf, view->strides[0], view->strides[1], view->shape[0], is_single};
        return 0;
    }
    PyErr_Format(PyExc_ValueError, "points are (N, 3) of format f or d; got %d dimensions of '%s'",
                 view->ndim, format);
    PyBuffer_Release(view);
    return -1;
}

static inline void
read_point(const Points *points, Py_ssize_t i, double p[3])
{
    const char *number = points->first + i * points->row;
    for (int k = 0; k < 3; k++, number += points->column) {
        if (points->is_single) {
            float single;
            memcpy(&single, number, sizeof(single));
            p[k] = single;
        }
        else
            memcpy(&p[k], number, sizeof(p[k]));
    }
}

/* The pose of a stamp that several points have. */
typedef struct {
    int64_t stamp;
    bool is_used;
    Pose pose;
} KeptPose;

/* One call: its arrays, and the poses or the curve that several points share. */
typedef struct {
    const Path *path;
    Batch batch;
    const Points *points;
    const int64_t *stamps;
    char *out;
    char *valid;
    KeptPose *kept;      /* SLOTS of them; NULL if few points share a stamp */
    Interval *intervals; /* of the tracks; NULL if points are placed one by one */
    int64_t from;        /* the instants of one curve, up to `until` */
    int64_t until;
    int halvings; /* of the period between two samples, so that a curve follows the path */
    Curve curve;
} Placing;

/* NaN, and not valid, if a number is not finite in the format of the points. */
static inline void
write_point(Placing *placing, Py_ssize_t i, const double p[3])
{
    if (placing->points->is_single) {
        float single[3] = {(float)p[0], (float)p[1], (float)p[2]};
        float sum = single[0] * 0.0f + single[1] * 0.0f + single[2] * 0.0f;
        for (int k = 0; k < 3; k++)
            single[k] += sum; /* 0 or NaN */
        memcpy(placing->out + (size_t)i * sizeof(single), single, sizeof(single));
        placing->valid[i] = sum == 0.0f;
        return;
    }
    double sum = p[0] * 0.0 + p[1] * 0.0 + p[2] * 0.0;
    const double known[3] = {p[0] + sum, p[1] + sum, p[2] + sum};
    memcpy(placing->out + (size_t)i * sizeof(known), known, sizeof(known));
    placing->valid[i] = sum == 0.0;
}

/* A lidar with several beams repeats its stamps for each of them. Their poses are kept, each in one
 * of the two slots that its stamp selects, until another stamp needs the slot. Slots are selected
 * by multiplicative hashing (Knuth, TAOCP 6.4), which spreads stamps at a constant rate evenly;
 * those of a real sensor vary by microseconds, and one slot each would be shared by a fifth of
 * 1024. */
#define SLOT_BITS 12
#define SLOTS (1 << SLOT_BITS)

static inline size_t
slot_of(int64_t stamp)
{
    return (size_t)(((uint64_t)stamp * UINT64_C(0x9E3779B97F4A7C15)) >> (64 - SLOT_BITS));
}

/* Whether kept poses would serve most points; with fewer points to a stamp, curves cost less. The
 * first stamps show it. */
static bool
are_repeated(const int64_t *stamps, Py_ssize_t count)
{
    int64_t kept[SLOTS] = {0};
    Py_ssize_t repeated = 0;
    count = count < 4 * SLOTS ? count : 4 * SLOTS;
    for (Py_ssize_t i = 0; i < count; i++) {
        int64_t *slot = &kept[slot_of(stamps[i])];
        repeated += *slot == stamps[i];
        *slot = stamps[i];
    }
    return repeated > count - count / 3;
}

/* The slot with the pose of an instant, or the one for it: the first of its two, unless only the
 * second is free. */
static inline KeptPose *
find_slot(KeptPose *kept, int64_t at)
{
    KeptPose *first = &kept[slot_of(at)], *second = &kept[slot_of(at) ^ 1];
    if (!first->is_used || first->stamp == at)
        return first;
    return !second->is_used || second->stamp == at ? second : first;
}

/* The pose at an instant, NaN without one. */
static Pose
pose_or_nan(Placing *placing, int64_t at)
{
    Pose pose = {Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN};
    KeptPose *slot = placing->kept == NULL ? NULL : find_slot(placing->kept, at);
    if (slot != NULL && slot->is_used && slot->stamp == at)
        return slot->pose;
    batch_pose(placing->path, &placing->batch, at, &pose);
    if (slot != NULL)
        *slot = (KeptPose){at, true, pose};
    return pose;
}

/* Points first to end, one by one. `step` is 0 if all points have the first stamp, else 1. */
static void
place_each(Placing *placing, Py_ssize_t first, Py_ssize_t end, Py_ssize_t step)
{
    Pose pose = identity;
    for (Py_ssize_t i = first; i < end; i++) {
        int64_t at = placing->stamps[i * step];
        if (i == first || at != placing->stamps[(i - 1) * step])
            pose = pose_or_nan(placing, at);
        double p[3], placed[3] = {pose.x, pose.y, pose.z};
        const double q[4] = {pose.qx, pose.qy, pose.qz, pose.qw};
        read_point(placing->points, i, p);
        add_rotated(placed, q, p);
        write_point(placing, i, placed);
    }
}

/* The samples of all tracks around an instant, and the instants that one curve may describe: those
 * with the same samples before and after them, or a part of them. False if a track ends before or
 * at this instant. */
static bool
find_intervals(Placing *placing, int64_t at)
{
    Batch *batch = &placing->batch;
    if (at < batch->oldest || at >= batch->newest)
        return false;
    placing->from = INT64_MIN;
    placing->until = INT64_MAX;
    for (Py_ssize_t i = 0; i < batch->tracks; i++) {
        Window *window = &batch->windows[i];
        const Block *block = window->block;
        Py_ssize_t near = index_from_near(window, at);
        window->near = near;
        near += block->stamps[near] == at; /* an instant of a sample begins an interval */
        int64_t earlier = block->stamps[near - 1], later = block->stamps[near];
        const double *row = block->rows + (size_t)near * (size_t)block->width;
        batch->nows[i] = (Bracket){row - block->width, row, 0.0};
        placing->intervals[i] = (Interval){earlier, (double)((uint64_t)later - (uint64_t)earlier)};
        placing->from = earlier > placing->from ? earlier : placing->from;
        placing->until = later < placing->until ? later : placing->until;
    }
    if ((uint64_t)placing->until - (uint64_t)placing->from > INT64_MAX)
        return false;
    int64_t part = (placing->until - placing->from) >> placing->halvings;
    part = part > 0 ? part : 1;
    placing->from += (at - placing->from) / part * part;
    if (placing->until - placing->from > part)
        placing->until = placing->from + part;
    return true;
}

static void
place_chunk(Placing *placing, Py_ssize_t first, Py_ssize_t count)
{
    const Curve *curve = &placing->curve;
    Chunk chunk;
    chunk.count = count;
    for (Py_ssize_t i = 0; i < count; i++) {
        double p[3];
        read_point(placing->points, first + i, p);
        chunk.at[i] = (double)(placing->stamps[first + i] - curve->begin) * curve->rate - 1.0;
        chunk.x[i] = p[0];
        chunk.y[i] = p[1];
        chunk.z[i] = p[2];
    }
    curve_apply(curve, &chunk);
    for (Py_ssize_t i = 0; i < count; i++) {
        const double placed[3] = {chunk.x[i], chunk.y[i], chunk.z[i]};
        write_point(placing, first + i, placed);
    }
}

/* Points first to end, all of them on the curve. */
static void
place_on_curve(Placing *placing, Py_ssize_t first, Py_ssize_t end)
{
    for (Py_ssize_t i = first; i < end; i += CHUNK)
        place_chunk(placing, i, end - i < CHUNK ? end - i : CHUNK);
}

/* For fewer points a curve costs more than their poses. */
#define FEW_POINTS 12
#define MAX_HALVINGS 6

/* The curve of the instants that find_intervals has found; as curve_of. */
static double
find_curve(Placing *placing)
{
    Batch *batch = &placing->batch;
    return curve_of(&placing->curve, placing->path, batch->nows, placing->intervals, batch->tracks,
                    placing->from, placing->until);
}

static void
place_intervals(Placing *placing)
{
    const int64_t *stamps = placing->stamps;
    Py_ssize_t count = placing->points->count, end;
    for (Py_ssize_t first = 0; first < count; first = end) {
        end = first + 1;
        if (find_intervals(placing, stamps[first]))
            while (end < count && stamps[end] >= placing->from && stamps[end] < placing->until)
                end++;
        double last = end - first > FEW_POINTS ? find_curve(placing) : Py_NAN;
        if (last <= LAST_TERMS)
            place_on_curve(placing, first, end);
        else if (last > LAST_TERMS && placing->halvings < MAX_HALVINGS) {
            placing->halvings++;
            end = first;
        }
        else
            place_each(placing, first, end, 1);
    }
}

static bool
placing_begin(Placing *placing, bool is_one_stamp)
{
    if (is_one_stamp)
        return true;
    if (are_repeated(placing->stamps, placing->points->count)) {
        placing->kept = PyMem_RawCalloc(SLOTS, sizeof(KeptPose));
        return placing->kept != NULL;
    }
    placing->intervals = PyMem_New(Interval, (size_t)placing->batch.tracks);
    return placing->intervals != NULL;
}

static void
place_run(Placing *placing)
{
    if (placing->intervals != NULL)
        place_intervals(placing);
    else
        place_each(placing, 0, placing->points->count, placing->kept != NULL);
}

static PyObject *
place_into(const Path *self, const Points *points, const Py_buffer *stamps, const Py_buffer *out,
           const Py_buffer *valid)
{
    Py_ssize_t count = points->count;
    const char *format = points->is_single ? "f" : "d";
    Py_ssize_t row = 3 * (Py_ssize_t)(points->is_single ? sizeof(float) : sizeof(double));
    if ((count_of(stamps) != 1 && count_of(stamps) != count) || valid->len != count ||
        out->len / row != count || out->len % row != 0 || out->format == NULL ||
        strcmp(out->format, format) != 0) {
        PyErr_SetString(PyExc_ValueError, "points have one stamp or one each, three numbers of "
                                          "their format in out and a byte in valid");
        return NULL;
    }
    Placing placing = {.path = self,
                       .points = points,
                       .stamps = stamps->buf,
                       .out = out->buf,
                       .valid = valid->buf};
    if (batch_begin(self, &placing.batch) < 0)
        return NULL;
    bool has_memory = placing_begin(&placing, count_of(stamps) == 1 || placing.batch.tracks == 0);
    if (has_memory) {
        Py_BEGIN_ALLOW_THREADS place_run(&placing);
        Py_END_ALLOW_THREADS
    }
    PyMem_RawFree(placing.kept);
    PyMem_Free(placing.intervals);
    PyObject *windows = has_memory ? windows_of(&placing.batch) : PyErr_NoMemory();
    batch_release(&placing.batch);
    return windows;
}

static PyObject *
path_place(Path *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer given, stamps, out, valid;
    Points points;
    PyObject *done = NULL;
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "place(points, stamps, out, valid)");
        return NULL;
    }
    if (get_points(args[0], &given, &points) < 0)
        return NULL;
    if (get_stamps(args[1], &stamps) < 0)
        goto release_points;
    if (PyObject_GetBuffer(args[2], &out, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | PyBUF_WRITABLE) < 0)
        goto release_stamps;
    if (PyObject_GetBuffer(args[3], &valid, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0)
        goto release_out;
    done = place_into(self, &points, &stamps, &out, &valid);
    PyBuffer_Release(&valid);
release_out:
    PyBuffer_Release(&out);
release_stamps:
    PyBuffer_Release(&stamps);
release_points:
    PyBuffer_Release(&given);
    return done;
}
