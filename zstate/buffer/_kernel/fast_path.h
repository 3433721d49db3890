/* FastPath: inserts the usual next message of one writer, for zstate/buffer/history.py.
 *
 * A message of the native wire is a MessagePack array: stamp, seq, session, digest of the order,
 * one or more blocks of numbers, and whatever else its type has (zstate/wire/messages.py). The
 * usual next message is the last one but for a newer stamp, seq + 1 and other numbers; all other
 * bytes are the same, so what was checked of the last message holds for it. So it is with a message
 * of the ros2 wire, a JointState with its attachment (ros_message.h), but for the time of sending,
 * too.
 */

#define LARGEST_BLOCKS 4

/* A block in the bytes of a message behind its head: there, and its first column in a history. */
typedef struct {
    Py_ssize_t start;
    Py_ssize_t count;
    Py_ssize_t column; /* -1: not kept */
} NumberBlock;

typedef struct {
    PyObject_HEAD
    PyObject *waiters;  /* dict: the waiters for each track */
    PyObject *counts;   /* dict: "received" */
    PyObject *sources;  /* tuple: objects with an attribute "version" */
    PyObject *versions; /* tuple: those at which the next message may be inserted */
    PyObject *track;    /* what `waiters` is searched for */
    History *history;
    PyObject *last; /* bytes: the last message; NULL if none is expected */
    Py_ssize_t rest_at;
    NumberBlock blocks[LARGEST_BLOCKS];
    Py_ssize_t block_count;
    bool holds_poses;
    bool is_expecting;
    int64_t next_seq;
    int64_t newest;
} FastPath;

static PyObject *version_name, *received_name, *no_waiters;

/* Reading MessagePack. Each advances *at and is false at anything else. */

static bool
read_big_endian(const uint8_t *bytes, Py_ssize_t size, Py_ssize_t *at, int width, uint64_t *number)
{
    if (size - *at < width)
        return false;
    *number = 0;
    for (int i = 0; i < width; i++)
        *number = *number << 8 | bytes[*at + i];
    *at += width;
    return true;
}

/* An integer of 64 bits with sign. */
static bool
read_integer(const uint8_t *bytes, Py_ssize_t size, Py_ssize_t *at, int64_t *number)
{
    uint64_t raw;
    if (*at >= size)
        return false;
    uint8_t type = bytes[(*at)++];
    if (type <= 0x7f || type >= 0xe0) {
        *number = (int8_t)type;
        return true;
    }
    if (type < 0xcc || type > 0xd3)
        return false;
    int width = 1 << (type & 3);
    if (!read_big_endian(bytes, size, at, width, &raw))
        return false;
    if (type >= 0xd0 && width < 8) {
        uint64_t sign = (uint64_t)1 << (8 * width - 1);
        *number = (int64_t)(raw ^ sign) - (int64_t)sign;
        return true;
    }
    *number = (int64_t)raw;
    return type >= 0xd0 || raw <= INT64_MAX;
}

static bool
read_bytes(const uint8_t *bytes, Py_ssize_t size, Py_ssize_t *at, Py_ssize_t *length)
{
    uint64_t raw;
    if (*at >= size || bytes[*at] < 0xc4 || bytes[*at] > 0xc6)
        return false;
    int width = 1 << (bytes[(*at)++] - 0xc4);
    if (!read_big_endian(bytes, size, at, width, &raw) || raw > (uint64_t)(size - *at))
        return false;
    *length = (Py_ssize_t)raw;
    return true;
}

/* The stamp and the seq of a message; *at is behind its head. */
static bool
read_head(const uint8_t *bytes, Py_ssize_t size, Py_ssize_t *at, int64_t *stamp, int64_t *seq)
{
    if (is_ros_message(bytes, size))
        return read_ros_head(bytes, size, at, stamp, seq);
    *at = 1;
    return size > 0 && (bytes[0] & 0xf0) == 0x90 && read_integer(bytes, size, at, stamp) &&
           read_integer(bytes, size, at, seq);
}

/* Skips session and digest, and finds the blocks behind them. */
static bool
read_blocks(FastPath *self, const uint8_t *bytes, Py_ssize_t size)
{
    uint64_t session;
    Py_ssize_t at = self->rest_at, length;
    if (at < size && bytes[at] == 0xcf) {
        at++;
        if (!read_big_endian(bytes, size, &at, 8, &session))
            return false;
    }
    else {
        int64_t small;
        if (!read_integer(bytes, size, &at, &small))
            return false;
    }
    if (!read_bytes(bytes, size, &at, &length))
        return false;
    at += length;
    self->block_count = 0;
    while (self->block_count < SEQUENCES && read_bytes(bytes, size, &at, &length)) {
        if (length % 8 != 0)
            return false;
        self->blocks[self->block_count++] = (NumberBlock){at - self->rest_at, length / 8, -1};
        at += length;
    }
    return self->block_count > 0;
}

static bool
read_ros_blocks(FastPath *self, const uint8_t *bytes, Py_ssize_t size)
{
    Py_ssize_t starts[SEQUENCES], counts[SEQUENCES];
    self->block_count = read_ros_sequences(bytes, size, starts, counts);
    for (Py_ssize_t i = 0; i < self->block_count; i++)
        self->blocks[i] = (NumberBlock){starts[i] - self->rest_at, counts[i], -1};
    return self->block_count > 0 && !self->holds_poses;
}

/* Sequence number and time of the attachment, as a block that is not kept. */
static void
add_attachment_block(FastPath *self, Py_ssize_t size)
{
    Py_ssize_t start = size - ATTACHMENT_BYTES - self->rest_at;
    self->blocks[self->block_count++] = (NumberBlock){start, GID_LENGTH_AT / 8, -1};
}

/* Decides on the columns of the blocks; false if the history has no place for one. */
static bool
place_blocks(FastPath *self, Py_ssize_t position_count)
{
    NumberBlock *blocks = self->blocks;
    Py_ssize_t width = self->history->width;
    blocks[0].column = 0;
    if (self->holds_poses)
        return self->block_count == 1 && blocks[0].count > 0 && blocks[0].count % 7 == 0 &&
               (blocks[0].count == width || blocks[0].count == width - 3 * blocks[0].count);
    if (blocks[0].count != position_count || position_count > width)
        return false;
    if (self->block_count == 1)
        return true;
    blocks[1].column = position_count; /* velocities; efforts are not kept */
    return blocks[1].count > 0 && blocks[1].count == width - position_count;
}

static void
forget_last(FastPath *self)
{
    self->is_expecting = false;
    Py_CLEAR(self->versions);
    Py_CLEAR(self->track);
    Py_CLEAR(self->history);
    Py_CLEAR(self->last);
}

static PyObject *
fast_path_expect(FastPath *self, PyObject *args)
{
    PyObject *message, *track, *history, *versions;
    Py_ssize_t position_count;
    if (!PyArg_ParseTuple(args, "O!OO!nO!:expect", &PyBytes_Type, &message, &track, &History_type,
                          &history, &position_count, &PyTuple_Type, &versions))
        return NULL;
    if (PyTuple_GET_SIZE(versions) != PyTuple_GET_SIZE(self->sources)) {
        PyErr_SetString(PyExc_ValueError, "as many versions as sources are wanted");
        return NULL;
    }
    forget_last(self);
    Py_INCREF(message);
    Py_INCREF(track);
    Py_INCREF(history);
    Py_INCREF(versions);
    self->last = message;
    self->track = track;
    self->history = (History *)history;
    self->versions = versions;
    self->holds_poses = position_count < 0;
    const uint8_t *bytes = (const uint8_t *)PyBytes_AS_STRING(message);
    Py_ssize_t size = PyBytes_GET_SIZE(message);
    int64_t seq;
    bool is_ros = is_ros_message(bytes, size);
    self->is_expecting = PY_LITTLE_ENDIAN && PyBytes_CheckExact(message) &&
                         read_head(bytes, size, &self->rest_at, &self->newest, &seq) && seq >= 0 &&
                         seq < INT64_MAX &&
                         (is_ros ? read_ros_blocks : read_blocks)(self, bytes, size) &&
                         place_blocks(self, position_count);
    if (!self->is_expecting)
        forget_last(self);
    else {
        self->next_seq = seq + 1;
        if (is_ros)
            add_attachment_block(self, size);
    }
    return PyBool_FromLong(self->is_expecting);
}

/* Whether the bytes behind the head are those of the last message, except for the blocks. */
static bool
equals_last(const FastPath *self, const uint8_t *rest, Py_ssize_t size)
{
    const uint8_t *last = (const uint8_t *)PyBytes_AS_STRING(self->last) + self->rest_at;
    if (size != PyBytes_GET_SIZE(self->last) - self->rest_at)
        return false;
    Py_ssize_t at = 0;
    for (Py_ssize_t i = 0; i < self->block_count; i++) {
        const NumberBlock *block = &self->blocks[i];
        if (memcmp(rest + at, last + at, (size_t)(block->start - at)) != 0)
            return false;
        at = block->start + 8 * block->count;
    }
    return memcmp(rest + at, last + at, (size_t)(size - at)) == 0;
}

/* Writes the numbers into a row; false if they need the checks of the reference. */
static bool
write_numbers(const FastPath *self, const uint8_t *rest, double *row)
{
    Py_ssize_t end = 0;
    for (Py_ssize_t i = 0; i < self->block_count; i++) {
        const NumberBlock *block = &self->blocks[i];
        if (block->column < 0)
            continue;
        memcpy(row + block->column, rest + block->start, 8 * (size_t)block->count);
        end = block->column + block->count;
    }
    if (self->holds_poses) {
        if (!are_poses((const char *)row, end))
            return false;
        normalise_poses(row, end);
    }
    else if (!all_finite(row, end))
        return false;
    fill_unknown(row, end, self->history->width);
    return true;
}

/* 1 if each source has its version, 0 for another one, -1 and an error. Reading an attribute may
 * run any Python code: nothing else of `self` may be used across the call. */
static int
has_versions(PyObject *sources, PyObject *versions)
{
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(sources); i++) {
        PyObject *version = PyObject_GetAttr(PyTuple_GET_ITEM(sources, i), version_name);
        if (version == NULL)
            return -1;
        Py_DECREF(version); /* only its identity is used */
        if (version != PyTuple_GET_ITEM(versions, i))
            return 0;
    }
    return 1;
}

static int
count_received(const FastPath *self)
{
    PyObject *count = PyDict_GetItemWithError(self->counts, received_name);
    if (count == NULL && PyErr_Occurred())
        return -1;
    long long before = count == NULL ? 0 : PyLong_AsLongLong(count);
    if (before == -1 && PyErr_Occurred())
        return -1;
    PyObject *after = PyLong_FromLongLong((long long)((unsigned long long)before + 1));
    int done = after == NULL ? -1 : PyDict_SetItem(self->counts, received_name, after);
    Py_XDECREF(after);
    return done;
}

/* 1 inserted, 0 not the usual next message, -1 and an error. */
static int
insert_next(FastPath *self, PyObject *message, int64_t earliest, int64_t latest)
{
    int64_t stamp, seq;
    Py_ssize_t rest_at;
    const uint8_t *bytes = (const uint8_t *)PyBytes_AS_STRING(message);
    Py_ssize_t size = PyBytes_GET_SIZE(message);
    History *history = self->history;
    bool is_next = bytes[0] == *(const uint8_t *)PyBytes_AS_STRING(self->last) &&
                   read_head(bytes, size, &rest_at, &stamp, &seq) && seq == self->next_seq &&
                   seq < INT64_MAX && stamp > self->newest && stamp >= earliest &&
                   stamp <= latest && equals_last(self, bytes + rest_at, size - rest_at);
    if (!is_next || history->is_closed || !history_reaches(history, stamp))
        return 0;
    Slot slot;
    if (slot_for(history, stamp, &slot) < 0)
        return -1;
    if (!write_numbers(self, bytes + rest_at, slot_write_stamp(&slot, stamp))) {
        Py_DECREF(slot.block);
        return 0;
    }
    slot_publish(history, &slot);
    self->next_seq = seq + 1;
    self->newest = stamp;
    return count_received(self) < 0 ? -1 : 1;
}

static int
try_insert_next(FastPath *self, PyObject *const *args)
{
    int64_t earliest, latest;
    if (!self->is_expecting || !PyBytes_CheckExact(args[0]) || !plain_stamp(args[1], &earliest) ||
        !plain_stamp(args[2], &latest))
        return 0;
    PyObject *versions = self->versions;
    Py_INCREF(versions);
    int is_current = has_versions(self->sources, versions);
    Py_DECREF(versions);
    if (is_current <= 0 || !self->is_expecting)
        return is_current < 0 ? -1 : 0;
    return insert_next(self, args[0], earliest, latest);
}

static PyObject *
fast_path_insert(FastPath *self, PyObject *const *args, Py_ssize_t count)
{
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "insert(message, earliest, latest)");
        return NULL;
    }
    int inserted = try_insert_next(self, args);
    if (inserted <= 0) {
        self->is_expecting = false;
        if (inserted < 0)
            return NULL;
        Py_RETURN_NONE;
    }
    PyObject *track = self->track;
    Py_INCREF(track);
    PyObject *waiting = PyDict_GetItemWithError(self->waiters, track);
    if (waiting == NULL && !PyErr_Occurred())
        waiting = no_waiters;
    Py_XINCREF(waiting);
    Py_DECREF(track);
    return waiting;
}

static PyObject *
fast_path_stop(FastPath *self, PyObject *Py_UNUSED(ignored))
{
    bool had_last = self->last != NULL;
    forget_last(self);
    if (!had_last)
        Py_RETURN_NONE;
    return Py_BuildValue("(LL)", (long long)self->next_seq, (long long)self->newest);
}

static PyObject *
fast_path_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"waiters", "counts", "sources", NULL};
    PyObject *waiters, *counts, *sources;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!O!O!:FastPath", names, &PyDict_Type,
                                     &waiters, &PyDict_Type, &counts, &PyTuple_Type, &sources))
        return NULL;
    FastPath *self = (FastPath *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    Py_INCREF(waiters);
    Py_INCREF(counts);
    Py_INCREF(sources);
    self->waiters = waiters;
    self->counts = counts;
    self->sources = sources;
    return (PyObject *)self;
}

static int
fast_path_traverse(FastPath *self, visitproc visit, void *arg)
{
    Py_VISIT(self->waiters);
    Py_VISIT(self->counts);
    Py_VISIT(self->sources);
    Py_VISIT(self->versions);
    Py_VISIT(self->track);
    Py_VISIT(self->history);
    return 0;
}

/* The other references stay, because methods use them unchecked: a cycle leads through the track.
 */
static int
fast_path_clear(FastPath *self)
{
    forget_last(self);
    return 0;
}

static void
fast_path_dealloc(FastPath *self)
{
    PyObject_GC_UnTrack(self);
    forget_last(self);
    Py_XDECREF(self->waiters);
    Py_XDECREF(self->counts);
    Py_XDECREF(self->sources);
    Py_TYPE(self)->tp_free(self);
}

static PyMethodDef fast_path_methods[] = {
    {"expect", (PyCFunction)fast_path_expect, METH_VARARGS,
     "expect(message, track, history, position_count, versions): expect the message after this "
     "one, which was inserted; False if it cannot be."},
    {"insert", (PyCFunction)(void (*)(void))fast_path_insert, METH_FASTCALL,
     "insert(message, earliest, latest): insert the expected message and return the waiters for "
     "its "
     "track; None, and none is expected any more, for any other message."},
    {"stop", (PyCFunction)fast_path_stop, METH_NOARGS,
     "stop(): expect no message; the seq after the last one and its stamp, None without one."},
    {NULL},
};

static PyTypeObject FastPath_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.FastPath",
    .tp_doc = "Inserts the usual next message of one writer.",
    .tp_basicsize = sizeof(FastPath),
    .tp_new = fast_path_new,
    .tp_dealloc = (destructor)fast_path_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_traverse = (traverseproc)fast_path_traverse,
    .tp_clear = (inquiry)fast_path_clear,
    .tp_methods = fast_path_methods,
};
