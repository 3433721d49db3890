/* History: the samples of one track, for zstate/buffer/history.py. */

#define SMALLEST_CAPACITY 16
#define LARGEST_WIDTH (1 << 20)

typedef struct {
    PyObject_HEAD
    Block *block; /* never NULL; samples first to end are there */
    Py_ssize_t first;
    Py_ssize_t end;
    Py_ssize_t
        unused; /* slots at the front of the block that never had a sample: no reader sees them */
    Py_ssize_t width;
    int64_t span_ns;
    bool is_closed; /* another history takes its place */
} History;

static PyTypeObject History_type;

static int64_t
newest_of(const History *self)
{
    return self->block->stamps[self->end - 1];
}

static bool
is_empty(const History *self)
{
    return self->first == self->end;
}

/* The oldest stamp that is kept together with `newest`. */
static int64_t
limit_of(const History *self, int64_t newest)
{
    return newest < INT64_MIN + self->span_ns ? INT64_MIN : newest - self->span_ns;
}

/* Prefetches the rows around a guess: in a history larger than the caches they are loaded while the
 * stamps are still searched. Columns of a wide row beyond these lines are loaded later. */
static inline void
prefetch_rows(const Block *block, Py_ssize_t guess)
{
#if defined(__GNUC__)
    Py_ssize_t end = block->capacity * block->width, i = guess * block->width;
    Py_ssize_t stop = i + 2 * block->width < end ? i + 2 * block->width : end;
    for (stop = stop < i + 32 ? stop : i + 32; i < stop; i += 8)
        __builtin_prefetch(block->rows + i);
#else
    (void)block, (void)guess;
#endif
}

/* The first index whose stamp is not before `at`; `end` when there is none.
 *
 * Stamps of a track come at a nearly constant rate: the place that the mean period gives is a
 * better first guess than the middle. From there steps of doubled length find an interval to
 * bisect.
 */
static Py_ssize_t
index_not_before(const Block *block, Py_ssize_t first, Py_ssize_t end, int64_t at)
{
    const int64_t *stamps = block->stamps;
    if (first == end || at > stamps[end - 1])
        return end;
    Py_ssize_t low = first, high = end - 1;
    if (at <= stamps[low])
        return low;
    /* From here on stamps[low] < at <= stamps[high]. Differences may exceed what int64 holds. */
    double difference = (double)((uint64_t)at - (uint64_t)stamps[low]);
    double whole = (double)((uint64_t)stamps[high] - (uint64_t)stamps[low]);
    Py_ssize_t guess = low + (Py_ssize_t)(difference / whole * (double)(high - low));
    guess = guess > high ? high : guess;
    prefetch_rows(block, guess);
    Py_ssize_t step = 1;
    if (stamps[guess] >= at) {
        for (high = guess; high - low > step; step *= 2) {
            if (stamps[high - step] < at) {
                low = high - step;
                break;
            }
            high -= step;
        }
    }
    else {
        for (low = guess; high - low > step; step *= 2) {
            if (stamps[low + step] >= at) {
                high = low + step;
                break;
            }
            low += step;
        }
    }
    while (high - low > 1) {
        Py_ssize_t middle = low + (high - low) / 2;
        if (stamps[middle] < at)
            low = middle;
        else
            high = middle;
    }
    return high;
}

/* The place of a new sample: its block (a new reference) and slot, and the window afterwards. */
typedef struct {
    Block *block;
    Py_ssize_t at;
    Py_ssize_t first;
    Py_ssize_t end;
    Py_ssize_t unused;
} Slot;

static bool
history_reaches(const History *self, int64_t stamp)
{
    return is_empty(self) || stamp >= limit_of(self, newest_of(self));
}

/* Moves the samples to the front of their block, if the history alone refers to it: an array made
 * of it, or a batch that reads it, holds a reference. False if there is another reference, or if
 * little capacity would be gained. */
static bool
moved_to_front(History *self)
{
    Block *block = self->block;
    size_t size = (size_t)(self->end - self->first), width = (size_t)self->width;
    if (Py_REFCNT(block) != 1 || self->first == 0 || (size_t)self->first < size / 8)
        return false;
    memmove(block->stamps, block->stamps + self->first, size * 8);
    memmove(block->rows, block->rows + (size_t)self->first * width, size * width * 8);
    self->first = self->unused = 0;
    self->end = (Py_ssize_t)size;
    return true;
}

static int
slot_behind(History *self, Slot *slot)
{
    Block *block = self->block;
    Py_ssize_t size = self->end - self->first;
    if (self->end < block->capacity || moved_to_front(self)) {
        Py_INCREF(block);
        *slot = (Slot){block, self->end, self->first, self->end + 1, self->unused};
        return 0;
    }
    /* Both copies exist for a moment, and a long history of a large robot is megabytes: room for an
     * eighth more is enough to copy each sample but a few times. */
    Block *fresh = block_new(SMALLEST_CAPACITY + size + size / 8, self->width);
    if (fresh == NULL)
        return -1;
    block_copy(fresh, 0, block, self->first, self->end);
    *slot = (Slot){fresh, size, 0, size + 1, 0};
    return 0;
}

/* The slot before the first sample: a writer's past arrives newest first. */
static int
slot_before(const History *self, Slot *slot)
{
    Block *block = self->block;
    if (self->unused > 0 && self->unused == self->first) {
        Py_INCREF(block);
        *slot = (Slot){block, self->first - 1, self->first - 1, self->end, self->unused - 1};
        return 0;
    }
    Py_ssize_t size = self->end - self->first, spare = SMALLEST_CAPACITY + size / 8;
    Block *fresh = block_new(2 * spare + size + 1, self->width);
    if (fresh == NULL)
        return -1;
    block_copy(fresh, spare + 1, block, self->first, self->end);
    *slot = (Slot){fresh, spare, spare, spare + 1 + size, spare};
    return 0;
}

static int
slot_among(const History *self, int64_t stamp, Slot *slot)
{
    const Block *block = self->block;
    Py_ssize_t size = self->end - self->first;
    Py_ssize_t place = index_not_before(block, self->first, self->end, stamp);
    Py_ssize_t after = block->stamps[place] == stamp ? place + 1 : place;
    Py_ssize_t at = place - self->first;
    Block *fresh = block_new(SMALLEST_CAPACITY + size + size / 8, self->width);
    if (fresh == NULL)
        return -1;
    block_copy(fresh, 0, block, self->first, place);
    block_copy(fresh, at + 1, block, after, self->end);
    *slot = (Slot){fresh, at, 0, at + 1 + self->end - after, 0};
    return 0;
}

/* Finds a slot; the samples stay unchanged. -1 and MemoryError if there is no memory. */
static int
slot_for(History *self, int64_t stamp, Slot *slot)
{
    if (is_empty(self) || stamp > newest_of(self))
        return slot_behind(self, slot);
    if (stamp < self->block->stamps[self->first])
        return slot_before(self, slot);
    return slot_among(self, stamp, slot);
}

static double *
slot_write_stamp(const Slot *slot, int64_t stamp)
{
    slot->block->stamps[slot->at] = stamp;
    return slot->block->rows + (size_t)slot->at * (size_t)slot->block->width;
}

/* Adds the sample in the slot to the history, and removes those that are too old now. */
static void
slot_publish(History *self, const Slot *slot)
{
    Block *old = self->block;
    self->block = slot->block;
    self->first = slot->first;
    self->end = slot->end;
    self->unused = slot->unused;
    Py_DECREF(old);
    const int64_t *stamps = self->block->stamps;
    int64_t limit = limit_of(self, newest_of(self));
    while (stamps[self->first] < limit)
        self->first++;
}

static PyObject *
history_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"width", "span_ns", NULL};
    Py_ssize_t width;
    long long span_ns;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "nL:History", names, &width, &span_ns))
        return NULL;
    if (width < 0 || width > LARGEST_WIDTH || span_ns < 0) {
        PyErr_SetString(PyExc_ValueError,
                        "a history has a width up to 2**20, and a span of zero or more");
        return NULL;
    }
    Block *block = block_new(SMALLEST_CAPACITY, width);
    History *self = block != NULL ? (History *)type->tp_alloc(type, 0) : NULL;
    if (self == NULL) {
        Py_XDECREF(block);
        return NULL;
    }
    self->block = block;
    self->width = width;
    self->span_ns = span_ns;
    return (PyObject *)self;
}

static void
history_dealloc(History *self)
{
    Py_XDECREF(self->block);
    Py_TYPE(self)->tp_free(self);
}

static PyObject *
history_clear(History *self, PyObject *Py_UNUSED(ignored))
{
    Block *fresh = block_new(SMALLEST_CAPACITY, self->width);
    if (fresh == NULL)
        return NULL;
    Block *old = self->block;
    self->block = fresh;
    self->first = self->end = self->unused = 0;
    Py_DECREF(old);
    Py_RETURN_NONE;
}

static PyObject *
history_close(History *self, PyObject *Py_UNUSED(ignored))
{
    self->is_closed = true;
    Py_RETURN_NONE;
}

static PyObject *
history_reaches_stamp(History *self, PyObject *number)
{
    int64_t stamp;
    if (!checked_stamp(number, &stamp))
        return NULL;
    return PyBool_FromLong(history_reaches(self, stamp));
}

static PyObject *
history_insert(History *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t stamp;
    Py_buffer row;
    Slot slot;
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "insert(stamp, row)");
        return NULL;
    }
    if (!checked_stamp(args[0], &stamp) || get_doubles(args[1], &row, 0) < 0)
        return NULL;
    PyObject *inserted = NULL;
    if (count_of(&row) != self->width)
        PyErr_Format(PyExc_ValueError, "a row has %zd numbers, not %zd", self->width,
                     count_of(&row));
    else if (!history_reaches(self, stamp))
        inserted = Py_False;
    else if (slot_for(self, stamp, &slot) == 0) {
        /* memmove: the row may be a view of the destination. */
        memmove(slot_write_stamp(&slot, stamp), row.buf, (size_t)row.len);
        slot_publish(self, &slot);
        inserted = Py_True;
    }
    PyBuffer_Release(&row);
    Py_XINCREF(inserted);
    return inserted;
}

static void
fill_unknown(double *row, Py_ssize_t first, Py_ssize_t end)
{
    for (Py_ssize_t i = first; i < end; i++)
        row[i] = Py_NAN;
}

/* Writes positions, then velocities, NaN without. 1 inserted, 0 too old, -1 MemoryError. */
static int
insert_numbers(History *self, int64_t stamp, const Py_buffer *positions,
               const Py_buffer *velocities)
{
    Slot slot;
    if (!history_reaches(self, stamp))
        return 0;
    if (slot_for(self, stamp, &slot) < 0)
        return -1;
    double *row = slot_write_stamp(&slot, stamp);
    memmove(row, positions->buf, (size_t)positions->len);
    if (velocities != NULL)
        memmove(row + count_of(positions), velocities->buf, (size_t)velocities->len);
    else
        fill_unknown(row, count_of(positions), self->width);
    slot_publish(self, &slot);
    return 1;
}

static PyObject *
history_try_insert(History *self, PyObject *const *args, Py_ssize_t count)
{
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError,
                        "try_insert(stamp, positions, velocities, position_count)");
        return NULL;
    }
    Py_ssize_t position_count = PyLong_AsSsize_t(args[3]);
    if (position_count == -1 && PyErr_Occurred())
        return NULL;
    int64_t stamp;
    Py_buffer positions, velocities;
    bool has_velocities = args[2] != Py_None;
    if (position_count < 0 || position_count > self->width || !plain_stamp(args[0], &stamp) ||
        (has_velocities && position_count == self->width))
        Py_RETURN_NONE;
    if (!plain_block(args[1], &positions, position_count) &&
        !plain_numbers(args[1], &positions, position_count))
        Py_RETURN_NONE;
    if (has_velocities && !plain_numbers(args[2], &velocities, self->width - position_count)) {
        PyBuffer_Release(&positions);
        Py_RETURN_NONE;
    }
    int inserted = insert_numbers(self, stamp, &positions, has_velocities ? &velocities : NULL);
    PyBuffer_Release(&positions);
    if (has_velocities)
        PyBuffer_Release(&velocities);
    return inserted < 0 ? NULL : PyBool_FromLong(inserted);
}

/* As in zstate/transform.py. */
#define QUATERNION_TOLERANCE 1e-3

/* As check_poses in zstate/buffer/pose_tracks.py, with the same order of operations. */
static bool
are_poses(const char *block, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i += 7) {
        double pose[7];
        memcpy(pose, block + i * (Py_ssize_t)sizeof(double), sizeof pose);
        for (int k = 0; k < 7; k++)
            if (!isfinite(pose[k]))
                return false;
        double *q = pose + 3;
        double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        if (!(fabs(norm - 1.0) <= QUATERNION_TOLERANCE))
            return false;
    }
    return true;
}

static void
normalise_poses(double *row, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i += 7) {
        double *q = row + i + 3;
        double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int k = 0; k < 4; k++)
            q[k] /= norm;
    }
}

static PyObject *
history_try_insert_poses(History *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t stamp;
    Slot slot;
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "try_insert_poses(stamp, block)");
        return NULL;
    }
    if (!PyBytes_CheckExact(args[1]) || !plain_stamp(args[0], &stamp))
        Py_RETURN_NONE;
    Py_ssize_t numbers = PyBytes_GET_SIZE(args[1]) / (Py_ssize_t)sizeof(double);
    bool fits = PyBytes_GET_SIZE(args[1]) % (Py_ssize_t)(7 * sizeof(double)) == 0 && numbers > 0 &&
                (numbers == self->width || (numbers < self->width && numbers * 4 == self->width));
    if (!fits || !are_poses(PyBytes_AS_STRING(args[1]), numbers))
        Py_RETURN_NONE;
    if (!history_reaches(self, stamp))
        Py_RETURN_FALSE;
    if (slot_for(self, stamp, &slot) < 0)
        return NULL;
    double *row = slot_write_stamp(&slot, stamp);
    memcpy(row, PyBytes_AS_STRING(args[1]), (size_t)PyBytes_GET_SIZE(args[1]));
    normalise_poses(row, numbers);
    fill_unknown(row, numbers, self->width);
    slot_publish(self, &slot);
    Py_RETURN_TRUE;
}

static bool
ascending(const int64_t *stamps, Py_ssize_t count)
{
    for (Py_ssize_t i = 1; i < count; i++)
        if (stamps[i] <= stamps[i - 1])
            return false;
    return true;
}

static PyObject *
history_replace(History *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer stamps, rows;
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "replace(stamps, rows)");
        return NULL;
    }
    if (get_stamps(args[0], &stamps) < 0)
        return NULL;
    if (get_doubles(args[1], &rows, 0) < 0) {
        PyBuffer_Release(&stamps);
        return NULL;
    }
    Py_ssize_t size = count_of(&stamps);
    Block *fresh = NULL;
    /* Counted by division: a product of sizes could overflow. */
    bool fits = self->width == 0
                    ? rows.len == 0
                    : count_of(&rows) % self->width == 0 && count_of(&rows) / self->width == size;
    if (!fits || !ascending(stamps.buf, size))
        PyErr_SetString(PyExc_ValueError,
                        "stamps ascend, and each has a row as wide as the history");
    else
        fresh = block_new(size < SMALLEST_CAPACITY ? SMALLEST_CAPACITY : size, self->width);
    if (fresh != NULL) {
        memcpy(fresh->stamps, stamps.buf, (size_t)stamps.len);
        memcpy(fresh->rows, rows.buf, (size_t)rows.len);
    }
    PyBuffer_Release(&rows);
    PyBuffer_Release(&stamps);
    if (fresh == NULL)
        return NULL;
    Block *old = self->block;
    self->block = fresh;
    self->first = self->unused = 0;
    self->end = size;
    Py_DECREF(old);
    Py_RETURN_NONE;
}

static PyObject *
history_window(History *self, void *Py_UNUSED(closure))
{
    /* A new tuple may run the garbage collector, and so any code: it might free the block. */
    PyObject *block = (PyObject *)self->block;
    Py_INCREF(block);
    return Py_BuildValue("(Nnn)", block, self->first, self->end);
}

static PyObject *
history_newest_stamp(History *self, void *Py_UNUSED(closure))
{
    if (self->first == self->end)
        Py_RETURN_NONE;
    return PyLong_FromLongLong(self->block->stamps[self->end - 1]);
}

static PyObject *
history_oldest_stamp(History *self, void *Py_UNUSED(closure))
{
    if (self->first == self->end)
        Py_RETURN_NONE;
    return PyLong_FromLongLong(self->block->stamps[self->first]);
}

static PyMethodDef history_methods[] = {
    {"insert", (PyCFunction)(void (*)(void))history_insert, METH_FASTCALL,
     "insert(stamp, row): False when the stamp is older than the history reaches."},
    {"try_insert", (PyCFunction)(void (*)(void))history_try_insert, METH_FASTCALL,
     "try_insert(stamp, positions, velocities, position_count): as insert, of arrays, positions "
     "also as "
     "a block; None for what is not plain."},
    {"try_insert_poses", (PyCFunction)(void (*)(void))history_try_insert_poses, METH_FASTCALL,
     "try_insert_poses(stamp, block): as insert, of a block of poses, quaternions normalised and "
     "further columns NaN; None for what is not plain."},
    {"replace", (PyCFunction)(void (*)(void))history_replace, METH_FASTCALL,
     "replace(stamps, rows): replace all samples by copies of these."},
    {"reaches", (PyCFunction)history_reaches_stamp, METH_O,
     "reaches(stamp): whether a sample of that stamp would be kept."},
    {"clear", (PyCFunction)history_clear, METH_NOARGS, "clear(): remove every sample."},
    {"close", (PyCFunction)history_close, METH_NOARGS,
     "close(): accept no more samples from a FastPath."},
    {NULL},
};

static PyMemberDef history_members[] = {
    {"width", T_PYSSIZET, offsetof(History, width), READONLY, "How many numbers a sample has."},
    {"span_ns", T_LONGLONG, offsetof(History, span_ns), READONLY, "How far back it reaches [ns]."},
    {NULL},
};

static PyGetSetDef history_getset[] = {
    {"window", (getter)history_window, NULL, "(block, first, end): where the samples are.", NULL},
    {"newest", (getter)history_newest_stamp, NULL, "The last stamp [ns]; None without any.", NULL},
    {"oldest", (getter)history_oldest_stamp, NULL, "The first stamp [ns]; None without any.", NULL},
    {NULL},
};

static PyTypeObject History_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.History",
    .tp_doc = "Samples of some numbers each, kept until span_ns older than the newest.",
    .tp_basicsize = sizeof(History),
    .tp_new = history_new,
    .tp_dealloc = (destructor)history_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE,
    .tp_methods = history_methods,
    .tp_members = history_members,
    .tp_getset = history_getset,
};

/* insert_together(histories, stamp, rows): all of them or none, at one moment. */

static int
write_together(PyObject *histories, int64_t stamp, Py_buffer *rows, Slot *slots)
{
    Py_ssize_t count = PyTuple_GET_SIZE(histories), reserved = 0;
    while (reserved < count) {
        if (slot_for((History *)PyTuple_GET_ITEM(histories, reserved), stamp, &slots[reserved]) < 0)
            break;
        reserved++;
    }
    if (reserved < count) {
        while (reserved-- > 0)
            Py_DECREF(slots[reserved].block);
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        memmove(slot_write_stamp(&slots[i], stamp), rows[i].buf, (size_t)rows[i].len);
        slot_publish((History *)PyTuple_GET_ITEM(histories, i), &slots[i]);
    }
    return 0;
}

static bool
can_be_together(PyObject *histories, PyObject *rows)
{
    Py_ssize_t count = PyTuple_GET_SIZE(histories);
    if (PyTuple_GET_SIZE(rows) != count)
        return false;
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *history = PyTuple_GET_ITEM(histories, i);
        if (!PyObject_TypeCheck(history, &History_type))
            return false;
        for (Py_ssize_t k = 0; k < i; k++)
            if (PyTuple_GET_ITEM(histories, k) == history)
                return false;
    }
    return true;
}

static PyObject *
insert_together(PyObject *Py_UNUSED(module), PyObject *args)
{
    PyObject *histories, *rows;
    long long stamp;
    if (!PyArg_ParseTuple(args, "O!LO!:insert_together", &PyTuple_Type, &histories, &stamp,
                          &PyTuple_Type, &rows))
        return NULL;
    if (!can_be_together(histories, rows)) {
        PyErr_SetString(PyExc_ValueError,
                        "as many rows as histories are wanted, each history once");
        return NULL;
    }
    size_t count = (size_t)PyTuple_GET_SIZE(histories), open = 0;
    Py_buffer *views = PyMem_New(Py_buffer, count + 1);
    Slot *slots = PyMem_New(Slot, count + 1);
    int done = views == NULL || slots == NULL ? -1 : 0;
    if (done < 0)
        PyErr_NoMemory();
    while (done == 0 && open < count) {
        const History *history = (History *)PyTuple_GET_ITEM(histories, (Py_ssize_t)open);
        done = get_doubles(PyTuple_GET_ITEM(rows, (Py_ssize_t)open), &views[open], 0);
        if (done == 0 && count_of(&views[open++]) != history->width) {
            PyErr_SetString(PyExc_ValueError, "a row is as wide as its history");
            done = -1;
        }
    }
    if (done == 0)
        done = write_together(histories, stamp, views, slots);
    while (open-- > 0)
        PyBuffer_Release(&views[open]);
    PyMem_Free(views);
    PyMem_Free(slots);
    if (done < 0)
        return NULL;
    Py_RETURN_NONE;
}
