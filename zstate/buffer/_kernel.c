/* The hot loops of the buffer: histories of samples, and compiled paths over them.
 *
 * What each thing means is said by the Python that it stands in for, which stays complete:
 * zstate/buffer/history.py (History), path.py, cells.py and steps.py (Path), zstate/facts.py (Facts),
 * zstate/model/edges.py (Edges). Differences to those are bugs, and tests compare both.
 *
 * Threads. Whatever changes or takes references runs with the GIL. The rows of a block that a window
 * covers are never written again, so a batch that holds references to its blocks reads them without
 * the GIL. A call with the GIL sees all histories between two inserts, because an insert, also one
 * into several histories (insert_together), runs no Python code between its first write and its last.
 *
 * Whatever a caller hands in is checked where it comes in (formats, sizes, columns, kinds), so that no
 * argument can make the code below read or write outside of what it owns.
 */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

/* Grows with every change of what Python sees of this file, so that a library built from an older
 * source (an editable install that was not built again) is recognised and not used. */
#define REVISION 1

#define SMALLEST_CAPACITY 16
#define LARGEST_WIDTH (1 << 20)
#define PI 3.14159265358979323846
#define TAU 6.28318530717958647693

/* ------------------------------------------------------------------------------------------------
 * Numbers that come from Python
 */

/* The stamp in an exact int of 64 bits. False, without an error, for anything else: the caller then
 * leaves the question to the reference, which accepts it or says what is wrong. */
static bool
plain_stamp(PyObject *number, int64_t *stamp)
{
    int overflow = 0;
    if (!PyLong_CheckExact(number))
        return false;
    *stamp = PyLong_AsLongLongAndOverflow(number, &overflow);
    return overflow == 0;
}

/* A stamp, or TypeError or OverflowError. */
static bool
checked_stamp(PyObject *number, int64_t *stamp)
{
    *stamp = PyLong_AsLongLong(number);
    return *stamp != -1 || !PyErr_Occurred();
}

/* A C-contiguous buffer of 8-byte items of one of these formats. -1 and BufferError, TypeError or
 * ValueError when it is none. */
static int
get_items(PyObject *object, Py_buffer *view, const char *formats, int flags)
{
    if (PyObject_GetBuffer(object, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | flags) < 0)
        return -1;
    const char *format = view->format != NULL ? view->format : "B";
    if (view->itemsize == 8 && strlen(format) == 1 && strchr(formats, format[0]) != NULL)
        return 0;
    PyErr_Format(PyExc_ValueError, "a buffer of format %s is wanted, not '%s'", formats, format);
    PyBuffer_Release(view);
    return -1;
}

static int
get_doubles(PyObject *object, Py_buffer *view, int flags)
{
    return get_items(object, view, "d", flags);
}

/* int64 is "l" where a C long has 64 bits and "q" elsewhere. */
static int
get_stamps(PyObject *object, Py_buffer *view)
{
    return get_items(object, view, sizeof(long) == 8 ? "lq" : "q", 0);
}

static Py_ssize_t
count_of(const Py_buffer *view)
{
    return view->len / 8;
}

static bool
all_finite(const double *numbers, Py_ssize_t count)
{
    /* x * 0 is 0 for finite x and NaN otherwise: no branch in the loop. */
    double sum = 0.0;
    for (Py_ssize_t i = 0; i < count; i++)
        sum += numbers[i] * 0.0;
    return sum == 0.0;
}

/* ------------------------------------------------------------------------------------------------
 * Block: memory of one history, stamps first and rows behind them. A read-only buffer of bytes.
 */

typedef struct {
    PyObject_HEAD
    Py_ssize_t capacity;
    Py_ssize_t width;
    int64_t *stamps;
    double *rows;
} Block;

static PyTypeObject Block_type;

static Block *
block_new(Py_ssize_t capacity, Py_ssize_t width)
{
    if (capacity > PY_SSIZE_T_MAX / (8 * (width + 1)))
        return (Block *)PyErr_NoMemory();
    Block *block = PyObject_New(Block, &Block_type);
    if (block == NULL)
        return NULL;
    block->capacity = capacity;
    block->width = width;
    block->stamps = PyMem_RawMalloc((size_t)capacity * (size_t)(width + 1) * 8);
    if (block->stamps == NULL) {
        Py_DECREF(block);
        return (Block *)PyErr_NoMemory();
    }
    block->rows = (double *)(block->stamps + capacity);
    return block;
}

static void
block_dealloc(Block *self)
{
    PyMem_RawFree(self->stamps);
    PyObject_Free(self);
}

static int
block_getbuffer(Block *self, Py_buffer *view, int flags)
{
    Py_ssize_t size = self->capacity * (self->width + 1) * 8;
    return PyBuffer_FillInfo(view, (PyObject *)self, self->stamps, size, 1, flags);
}

/* Copies samples first to end to the place `at` of another block of the same width. */
static void
block_copy(Block *to, Py_ssize_t at, const Block *from, Py_ssize_t first, Py_ssize_t end)
{
    size_t count = (size_t)(end - first), width = (size_t)to->width;
    if (count == 0)
        return;
    memcpy(to->stamps + at, from->stamps + first, count * 8);
    if (width != 0)
        memcpy(to->rows + (size_t)at * width, from->rows + (size_t)first * width, count * width * 8);
}

static PyBufferProcs block_as_buffer = {.bf_getbuffer = (getbufferproc)block_getbuffer};

static PyMemberDef block_members[] = {
    {"capacity", T_PYSSIZET, offsetof(Block, capacity), READONLY, "How many samples there is room for."},
    {"width", T_PYSSIZET, offsetof(Block, width), READONLY, "How many numbers a sample has."},
    {NULL},
};

static PyTypeObject Block_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.Block",
    .tp_doc = "Memory of a history: int64 stamps, then float64 rows. A read-only buffer of bytes.",
    .tp_basicsize = sizeof(Block),
    .tp_dealloc = (destructor)block_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_as_buffer = &block_as_buffer,
    .tp_members = block_members,
};

/* ------------------------------------------------------------------------------------------------
 * History
 */

typedef struct {
    PyObject_HEAD
    Block *block; /* never NULL; samples first to end are there */
    Py_ssize_t first;
    Py_ssize_t end;
    Py_ssize_t width;
    int64_t span_ns;
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

/* The oldest stamp that is kept beside `newest`. */
static int64_t
limit_of(const History *self, int64_t newest)
{
    return newest < INT64_MIN + self->span_ns ? INT64_MIN : newest - self->span_ns;
}

/* The rows around a guess: in a history larger than the caches they are on their way while the stamps
 * are still being looked at. Columns of a wide row beyond these lines are waited for. */
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
 * Stamps of a track come at a nearly constant rate: where the mean period says, or near by, is a
 * better first guess than the middle. From there steps of doubled length find a stretch to bisect. */
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
    double way = (double)((uint64_t)at - (uint64_t)stamps[low]);
    double whole = (double)((uint64_t)stamps[high] - (uint64_t)stamps[low]);
    Py_ssize_t guess = low + (Py_ssize_t)(way / whole * (double)(high - low));
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

/* Where a sample goes: the block (a new reference) and place for it, and the window afterwards. */
typedef struct {
    Block *block;
    Py_ssize_t at;
    Py_ssize_t first;
    Py_ssize_t end;
} Slot;

static bool
history_reaches(const History *self, int64_t stamp)
{
    return is_empty(self) || stamp >= limit_of(self, newest_of(self));
}

/* Moves the samples to the front of their block, where nobody else can see it: an array made of it, or
 * a batch that reads it, would hold a reference. False when it is seen, or little room would be won. */
static bool
moved_to_front(History *self)
{
    Block *block = self->block;
    size_t size = (size_t)(self->end - self->first), width = (size_t)self->width;
    if (Py_REFCNT(block) != 1 || self->first == 0 || (size_t)self->first < size / 8)
        return false;
    memmove(block->stamps, block->stamps + self->first, size * 8);
    memmove(block->rows, block->rows + (size_t)self->first * width, size * width * 8);
    self->first = 0;
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
        *slot = (Slot){block, self->end, self->first, self->end + 1};
        return 0;
    }
    /* Both copies live for a moment, and a long history of a large robot is megabytes: room for an
     * eighth more is enough to copy each sample but a few times. */
    Block *fresh = block_new(SMALLEST_CAPACITY + size + size / 8, self->width);
    if (fresh == NULL)
        return -1;
    block_copy(fresh, 0, block, self->first, self->end);
    *slot = (Slot){fresh, size, 0, size + 1};
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
    *slot = (Slot){fresh, at, 0, at + 1 + self->end - after};
    return 0;
}

/* Finds room; the samples stay what they are. -1 and MemoryError when there is none. */
static int
slot_for(History *self, int64_t stamp, Slot *slot)
{
    if (is_empty(self) || stamp > newest_of(self))
        return slot_behind(self, slot);
    return slot_among(self, stamp, slot);
}

static double *
slot_write_stamp(const Slot *slot, int64_t stamp)
{
    slot->block->stamps[slot->at] = stamp;
    return slot->block->rows + (size_t)slot->at * (size_t)slot->block->width;
}

/* Makes the sample in the slot part of the history, and forgets what has become too old. */
static void
slot_publish(History *self, const Slot *slot)
{
    Block *old = self->block;
    self->block = slot->block;
    self->first = slot->first;
    self->end = slot->end;
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
        PyErr_SetString(PyExc_ValueError, "a history has a width up to 2**20, and a span of zero or more");
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
    self->first = self->end = 0;
    Py_DECREF(old);
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
    PyObject *taken = NULL;
    if (count_of(&row) != self->width)
        PyErr_Format(PyExc_ValueError, "a row has %zd numbers, not %zd", self->width, count_of(&row));
    else if (!history_reaches(self, stamp))
        taken = Py_False;
    else if (slot_for(self, stamp, &slot) == 0) {
        /* memmove: the row may be a view of the very memory it goes to. */
        memmove(slot_write_stamp(&slot, stamp), row.buf, (size_t)row.len);
        slot_publish(self, &slot);
        taken = Py_True;
    }
    PyBuffer_Release(&row);
    Py_XINCREF(taken);
    return taken;
}

/* Writes positions, then velocities or NaN in their stead. 1 taken, 0 too old, -1 MemoryError. */
static int
take_numbers(History *self, int64_t stamp, const Py_buffer *positions, const Py_buffer *velocities)
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
        for (Py_ssize_t i = count_of(positions); i < self->width; i++)
            row[i] = Py_NAN;
    slot_publish(self, &slot);
    return 1;
}

/* A flat buffer of finite doubles. False, without an error, for anything else. */
static bool
plain_numbers(PyObject *object, Py_buffer *view, Py_ssize_t count)
{
    if (!PyObject_CheckBuffer(object) || get_doubles(object, view, 0) < 0) {
        PyErr_Clear();
        return false;
    }
    if (view->ndim == 1 && count_of(view) == count && all_finite(view->buf, count))
        return true;
    PyBuffer_Release(view);
    return false;
}

static PyObject *
history_take(History *self, PyObject *const *args, Py_ssize_t count)
{
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "take(stamp, positions, velocities, position_count)");
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
    if (!plain_numbers(args[1], &positions, position_count))
        Py_RETURN_NONE;
    if (has_velocities && !plain_numbers(args[2], &velocities, self->width - position_count)) {
        PyBuffer_Release(&positions);
        Py_RETURN_NONE;
    }
    int taken = take_numbers(self, stamp, &positions, has_velocities ? &velocities : NULL);
    PyBuffer_Release(&positions);
    if (has_velocities)
        PyBuffer_Release(&velocities);
    return taken < 0 ? NULL : PyBool_FromLong(taken);
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
    bool fits = self->width == 0 ? rows.len == 0
                                 : count_of(&rows) % self->width == 0 && count_of(&rows) / self->width == size;
    if (!fits || !ascending(stamps.buf, size))
        PyErr_SetString(PyExc_ValueError, "stamps ascend, and each has a row as wide as the history");
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
    self->first = 0;
    self->end = size;
    Py_DECREF(old);
    Py_RETURN_NONE;
}

static PyObject *
history_window(History *self, void *Py_UNUSED(closure))
{
    return Py_BuildValue("(Onn)", self->block, self->first, self->end);
}

static PyMethodDef history_methods[] = {
    {"insert", (PyCFunction)(void (*)(void))history_insert, METH_FASTCALL,
     "insert(stamp, row): False when the stamp is older than the history reaches."},
    {"take", (PyCFunction)(void (*)(void))history_take, METH_FASTCALL,
     "take(stamp, positions, velocities, position_count): as insert; None for what is not plain."},
    {"replace", (PyCFunction)(void (*)(void))history_replace, METH_FASTCALL,
     "replace(stamps, rows): hold copies of these samples and no others."},
    {"reaches", (PyCFunction)history_reaches_stamp, METH_O,
     "reaches(stamp): whether a sample of that stamp would be kept."},
    {"clear", (PyCFunction)history_clear, METH_NOARGS, "clear(): forget every sample."},
    {NULL},
};

static PyMemberDef history_members[] = {
    {"width", T_PYSSIZET, offsetof(History, width), READONLY, "How many numbers a sample has."},
    {"span_ns", T_LONGLONG, offsetof(History, span_ns), READONLY, "How far back it reaches [ns]."},
    {NULL},
};

static PyGetSetDef history_getset[] = {
    {"window", (getter)history_window, NULL, "(block, first, end): where the samples are.", NULL},
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
    if (!PyArg_ParseTuple(args, "O!LO!:insert_together", &PyTuple_Type, &histories, &stamp, &PyTuple_Type,
                          &rows))
        return NULL;
    if (!can_be_together(histories, rows)) {
        PyErr_SetString(PyExc_ValueError, "as many rows as histories are wanted, each history once");
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

/* ------------------------------------------------------------------------------------------------
 * Rigid motions: zstate/se3.py, in the same order of operations
 */

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

/* sin(r * angle) / sin(angle), as a series in cos(angle) - 1 = -less / 2, where less is the squared
 * chord between two unit quaternions: D. Eberly, "A Fast and Accurate Algorithm for Computing SLERP"
 * (2011). Each factor is below 0.005 for less < SMALL_CHORD, so that eight leave nothing to see in a
 * double, and no trigonometry is needed between samples of usual rates. */
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
pose_between(const double *a, const double *b, double r)
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

/* ------------------------------------------------------------------------------------------------
 * Facts: what a Transform holds
 */

typedef struct {
    PyObject_HEAD
    PyObject *target;
    PyObject *source;
    PyObject *stamp;
    PyObject *kind;
    double predicted_s;
    Pose pose;
} Facts;

static PyTypeObject Facts_type;
static PyObject *kind_static, *kind_exact, *kind_interpolated;

/* A filled object of a class that is known to derive from Facts. */
static PyObject *
facts_new(PyTypeObject *type, PyObject *target, PyObject *source, Pose pose, PyObject *stamp, PyObject *kind)
{
    Facts *facts = (Facts *)type->tp_alloc(type, 0);
    if (facts == NULL)
        return NULL;
    Py_INCREF(target);
    Py_INCREF(source);
    Py_INCREF(stamp);
    Py_INCREF(kind);
    facts->target = target;
    facts->source = source;
    facts->stamp = stamp;
    facts->kind = kind;
    facts->pose = pose;
    return (PyObject *)facts;
}

static void
facts_dealloc(Facts *self)
{
    Py_CLEAR(self->target);
    Py_CLEAR(self->source);
    Py_CLEAR(self->stamp);
    Py_CLEAR(self->kind);
    Py_TYPE(self)->tp_free(self);
}

/* `count` floats of a tuple. -1 and TypeError or ValueError when it is none. */
static int
read_doubles(PyObject *tuple, double *numbers, Py_ssize_t count)
{
    if (!PyTuple_Check(tuple) || PyTuple_GET_SIZE(tuple) != count) {
        PyErr_Format(PyExc_ValueError, "a tuple of %zd numbers is wanted", count);
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        numbers[i] = PyFloat_AsDouble(PyTuple_GET_ITEM(tuple, i));
        if (numbers[i] == -1.0 && PyErr_Occurred())
            return -1;
    }
    return 0;
}

/* From (target, source, pose, stamp, kind, predicted_s=0.0). -1 and an exception for other arguments. */
static int
facts_fill(Facts *self, PyObject *const *args, Py_ssize_t count)
{
    double n[7];
    if (count < 5 || count > 6) {
        PyErr_SetString(PyExc_TypeError, "facts are target, source, pose, stamp, kind, predicted_s=0.0");
        return -1;
    }
    double predicted_s = count == 6 ? PyFloat_AsDouble(args[5]) : 0.0;
    if ((predicted_s == -1.0 && PyErr_Occurred()) || read_doubles(args[2], n, 7) < 0)
        return -1;
    if (self->target != NULL) {
        PyErr_SetString(PyExc_AttributeError, "facts are filled once");
        return -1;
    }
    Py_INCREF(args[0]);
    Py_INCREF(args[1]);
    Py_INCREF(args[3]);
    Py_INCREF(args[4]);
    self->target = args[0];
    self->source = args[1];
    self->stamp = args[3];
    self->kind = args[4];
    self->predicted_s = predicted_s;
    self->pose = (Pose){n[0], n[1], n[2], n[3], n[4], n[5], n[6]};
    return 0;
}

static PyObject *
facts_trusted(PyObject *type, PyObject *const *args, Py_ssize_t count)
{
    PyObject *self = ((PyTypeObject *)type)->tp_alloc((PyTypeObject *)type, 0);
    if (self != NULL && facts_fill((Facts *)self, args, count) < 0)
        Py_CLEAR(self);
    return self;
}

static PyObject *
facts_fill_once(Facts *self, PyObject *const *args, Py_ssize_t count)
{
    if (facts_fill(self, args, count) < 0)
        return NULL;
    Py_RETURN_NONE;
}

static PyObject *
facts_pose(Facts *self, void *Py_UNUSED(closure))
{
    const Pose p = self->pose;
    if (self->target == NULL) {
        PyErr_SetString(PyExc_AttributeError, "_pose");
        return NULL;
    }
    return Py_BuildValue("(ddddddd)", p.x, p.y, p.z, p.qx, p.qy, p.qz, p.qw);
}

static PyMethodDef facts_methods[] = {
    {"trusted", (PyCFunction)(void (*)(void))facts_trusted, METH_FASTCALL | METH_CLASS,
     "trusted($type, target, source, pose, stamp, kind, predicted_s=0.0, /)\n--\n\n"
     "From seven floats that are known to be a pose: for the buffer, which checked at insert."},
    {"_fill", (PyCFunction)(void (*)(void))facts_fill_once, METH_FASTCALL, "As trusted, for constructors."},
    {NULL},
};

static PyMemberDef facts_members[] = {
    {"target", T_OBJECT_EX, offsetof(Facts, target), READONLY, "The frame that it is given in."},
    {"source", T_OBJECT_EX, offsetof(Facts, source), READONLY, "The frame whose pose it is."},
    {"stamp", T_OBJECT_EX, offsetof(Facts, stamp), READONLY, "Its instant [ns], or None."},
    {"kind", T_OBJECT_EX, offsetof(Facts, kind), READONLY, "How it was made."},
    {"predicted_s", T_DOUBLE, offsetof(Facts, predicted_s), READONLY, "How far ahead [s]."},
    {NULL},
};

static PyGetSetDef facts_getset[] = {
    {"_pose", (getter)facts_pose, NULL, "x y z qx qy qz qw.", NULL},
    {NULL},
};

static PyTypeObject Facts_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.Facts",
    .tp_doc = "What a Transform holds.",
    .tp_basicsize = sizeof(Facts),
    .tp_new = PyType_GenericNew,
    .tp_dealloc = (destructor)facts_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE,
    .tp_methods = facts_methods,
    .tp_members = facts_members,
    .tp_getset = facts_getset,
};

/* ------------------------------------------------------------------------------------------------
 * Steps: one edge of a path each
 */

typedef enum { FIXED, HINGE, SLIDE, PLANAR, GIVEN, STEP_KINDS } StepKind;

/* How many numbers a step of each kind has, and how many columns of a row it reads. */
static const Py_ssize_t step_numbers[STEP_KINDS] = {7, 13, 12, 7, 7};
static const Py_ssize_t step_columns[STEP_KINDS] = {0, 1, 1, 3, 7};

typedef struct {
    StepKind kind;
    bool turns; /* the angle is a continuous joint's */
    Py_ssize_t use;
    Py_ssize_t column;
    double scale, shift;
    double q_cos[4], q_sin[4];
    double t0[3], t1[3];
    Pose origin; /* of fixed, planar and given steps; fixed ones have nothing else */
    bool at_origin; /* the origin is the identity */
} Step;

/* The rows around an instant in one track; a == b for an exact hit. */
typedef struct {
    const double *a;
    const double *b;
    double ratio;
} Between;

static inline double
line_between(double a, double b, double ratio)
{
    return a + ratio * (b - a);
}

static inline double
turn_between(double a, double b, double ratio)
{
    double way = b - a;
    if (fabs(way) > PI && fabs(a) <= PI && fabs(b) <= PI)
        way = way > 0.0 ? way - TAU : way + TAU;
    return a + ratio * way;
}

/* scale * joint + shift */
static inline double
travel(const Step *step, const Between *now)
{
    double a = now->a[step->column], b = now->b[step->column];
    double value = step->turns ? turn_between(a, b, now->ratio) : line_between(a, b, now->ratio);
    return step->scale * value + step->shift;
}

static inline Pose
hinge_pose(const Step *step, double angle)
{
    const double *a = step->q_cos, *b = step->q_sin;
    double half = 0.5 * angle, c = cos(half), s = sin(half);
    return (Pose){step->t0[0],         step->t0[1],         step->t0[2],        a[0] * c + b[0] * s,
                  a[1] * c + b[1] * s, a[2] * c + b[2] * s, a[3] * c + b[3] * s};
}

static inline Pose
slide_pose(const Step *step, double n)
{
    return (Pose){step->t0[0] + step->t1[0] * n, step->t0[1] + step->t1[1] * n, step->t0[2] + step->t1[2] * n,
                  step->q_cos[0],                step->q_cos[1],                step->q_cos[2],
                  step->q_cos[3]};
}

static Pose
planar_pose(const Step *step, const Between *now)
{
    const double *a = now->a + step->column, *b = now->b + step->column;
    double x = line_between(a[0], b[0], now->ratio), y = line_between(a[1], b[1], now->ratio);
    double half = 0.5 * turn_between(a[2], b[2], now->ratio);
    return compose(step->origin, (Pose){x, y, 0.0, 0.0, 0.0, sin(half), cos(half)});
}

static Pose
given_pose(const Step *step, const Between *now)
{
    Pose given = pose_between(now->a + step->column, now->b + step->column, now->ratio);
    return step->at_origin ? given : compose(step->origin, given);
}

static inline Pose
step_pose(const Step *step, const Between *nows)
{
    switch (step->kind) {
    case HINGE:
        return hinge_pose(step, travel(step, &nows[step->use]));
    case SLIDE:
        return slide_pose(step, travel(step, &nows[step->use]));
    case PLANAR:
        return planar_pose(step, &nows[step->use]);
    case GIVEN:
        return given_pose(step, &nows[step->use]);
    default:
        return step->origin;
    }
}

/* top_from_bottom; the identity of no steps. */
static Pose
chain_pose(const Step *steps, Py_ssize_t count, const Between *nows)
{
    if (count == 0)
        return identity;
    Pose pose = step_pose(&steps[0], nows);
    for (Py_ssize_t i = 1; i < count; i++)
        pose = compose(pose, step_pose(&steps[i], nows));
    return pose;
}

/* From (kind, use, column, turns, numbers). Uses and columns are checked by check_step. */
static int
read_step(PyObject *description, Step *step)
{
    int kind, turns;
    PyObject *tuple;
    double n[13];
    memset(step, 0, sizeof(*step));
    if (!PyTuple_Check(description)) {
        PyErr_SetString(PyExc_TypeError, "a step is a tuple (kind, use, column, turns, numbers)");
        return -1;
    }
    if (!PyArg_ParseTuple(description, "innpO:step", &kind, &step->use, &step->column, &turns, &tuple))
        return -1;
    if (kind < 0 || kind >= STEP_KINDS) {
        PyErr_Format(PyExc_ValueError, "there is no step of kind %d", kind);
        return -1;
    }
    if (read_doubles(tuple, n, step_numbers[kind]) < 0)
        return -1;
    step->kind = (StepKind)kind;
    step->turns = turns != 0;
    if (kind == HINGE || kind == SLIDE) {
        step->scale = n[0];
        step->shift = n[1];
        memcpy(step->q_cos, n + 2, sizeof(step->q_cos));
        memcpy(step->t0, n + 6, sizeof(step->t0));
        memcpy(kind == HINGE ? step->q_sin : step->t1, n + 9, (kind == HINGE ? 4 : 3) * sizeof(double));
        return 0;
    }
    step->origin = (Pose){n[0], n[1], n[2], n[3], n[4], n[5], n[6]};
    step->at_origin = memcmp(&step->origin, &identity, sizeof(identity)) == 0;
    return 0;
}

static int
check_step(const Step *step, Py_ssize_t use_count, const Py_ssize_t *widths)
{
    if (step->kind == FIXED)
        return 0;
    if (step->use >= 0 && step->use < use_count && step->column >= 0 &&
        step->column <= widths[step->use] - step_columns[step->kind])
        return 0;
    PyErr_Format(PyExc_ValueError, "a step reads column %zd of track %zd, which is not there", step->column,
                 step->use);
    return -1;
}

/* ------------------------------------------------------------------------------------------------
 * Path
 */

typedef struct {
    PyObject_HEAD
    PyTypeObject *type; /* of the answers: Transform, which derives from Facts */
    PyObject *target;
    PyObject *source;
    PyObject *histories; /* a tuple: the tracks that the path passes */
    Step *steps;         /* those to the target, then those to the source */
    Py_ssize_t to_target;
    Py_ssize_t to_source;
} Path;

static PyTypeObject Path_type;

/* One track as a path sees it during one call. */
typedef struct {
    const Block *block;
    Py_ssize_t first;
    Py_ssize_t end;
} Window;

/* So many tracks a path may pass before its calls need memory from the heap. */
#define FEW_TRACKS 16

static Py_ssize_t
track_count(const Path *self)
{
    return PyTuple_GET_SIZE(self->histories);
}

static inline Window
window_of(const Path *self, Py_ssize_t index)
{
    const History *history = (History *)PyTuple_GET_ITEM(self->histories, index);
    return (Window){history->block, history->first, history->end};
}

/* False where the track does not reach. */
static inline bool
rows_around(const Window *window, int64_t at, Between *now)
{
    const Block *block = window->block;
    Py_ssize_t after = index_not_before(block, window->first, window->end, at);
    if (after == window->end)
        return false;
    now->b = block->rows + (size_t)after * (size_t)block->width;
    now->a = now->b;
    now->ratio = 0.0;
    int64_t later = block->stamps[after];
    if (later == at)
        return true;
    if (after == window->first)
        return false;
    int64_t earlier = block->stamps[after - 1];
    now->a -= block->width;
    now->ratio = (double)((uint64_t)at - (uint64_t)earlier) / (double)((uint64_t)later - (uint64_t)earlier);
    return true;
}

static Pose
pose_at(const Path *self, const Between *nows)
{
    Pose source_from_top = chain_pose(self->steps + self->to_target, self->to_source, nows);
    if (self->to_target == 0)
        return source_from_top;
    Pose target_from_top = invert(chain_pose(self->steps, self->to_target, nows));
    return self->to_source == 0 ? target_from_top : compose(target_from_top, source_from_top);
}

/* The newest instant that all tracks know. False when one is empty. */
static bool
newest_common(const Path *self, int64_t *at)
{
    *at = INT64_MAX;
    for (Py_ssize_t i = 0; i < track_count(self); i++) {
        const History *history = (History *)PyTuple_GET_ITEM(self->histories, i);
        if (is_empty(history))
            return false;
        int64_t newest = newest_of(history);
        *at = newest < *at ? newest : *at;
    }
    return true;
}

static PyObject *
answer_static(const Path *self, PyObject *stamp)
{
    return facts_new(self->type, self->target, self->source, pose_at(self, NULL), stamp, kind_static);
}

/* The answer at an instant, or None; `stamp` is NULL or the very object it was asked with. */
static PyObject *
answer_at(const Path *self, int64_t at, PyObject *stamp, Between *nows)
{
    PyObject *kind = kind_exact;
    for (Py_ssize_t i = 0; i < track_count(self); i++) {
        Window window = window_of(self, i);
        if (!rows_around(&window, at, &nows[i]))
            Py_RETURN_NONE;
        if (nows[i].a != nows[i].b)
            kind = kind_interpolated;
    }
    Pose pose = normalized(pose_at(self, nows));
    if (stamp != NULL)
        return facts_new(self->type, self->target, self->source, pose, stamp, kind);
    stamp = PyLong_FromLongLong(at);
    if (stamp == NULL)
        return NULL;
    PyObject *answer = facts_new(self->type, self->target, self->source, pose, stamp, kind);
    Py_DECREF(stamp);
    return answer;
}

static PyObject *
path_at(Path *self, PyObject *const *args, Py_ssize_t count)
{
    PyObject *stamp = count == 1 ? args[0] : Py_None;
    int64_t at = 0;
    if (count > 1) {
        PyErr_SetString(PyExc_TypeError, "at(stamp=None)");
        return NULL;
    }
    if (stamp != Py_None && !plain_stamp(stamp, &at))
        Py_RETURN_NONE;
    Py_ssize_t tracks = track_count(self);
    if (tracks == 0)
        return answer_static(self, stamp);
    if (stamp == Py_None) {
        stamp = NULL;
        if (!newest_common(self, &at))
            Py_RETURN_NONE;
    }
    Between few[FEW_TRACKS];
    if (tracks <= FEW_TRACKS)
        return answer_at(self, at, stamp, few);
    Between *nows = PyMem_New(Between, (size_t)tracks);
    if (nows == NULL)
        return PyErr_NoMemory();
    PyObject *answer = answer_at(self, at, stamp, nows);
    PyMem_Free(nows);
    return answer;
}

/* blame(stamp): which track cannot answer, in the order of zstate/buffer/path.py. */

typedef enum { IN_PAST, NO_DATA, IN_FUTURE } Failure;

static PyObject *
failure_of(const Path *self, Failure failure, Py_ssize_t index, PyObject *stamp)
{
    const History *history = (History *)PyTuple_GET_ITEM(self->histories, index);
    if (is_empty(history))
        return Py_BuildValue("(inOOOO)", (int)failure, index, stamp, Py_None, Py_None, Py_None);
    long long oldest = history->block->stamps[history->first], newest = newest_of(history);
    if (oldest == newest)
        return Py_BuildValue("(inOLLO)", (int)failure, index, stamp, oldest, newest, Py_None);
    double periods = (double)(history->end - history->first - 1);
    double rate_hz = periods * 1e9 / (double)((uint64_t)newest - (uint64_t)oldest);
    return Py_BuildValue("(inOLLd)", (int)failure, index, stamp, oldest, newest, rate_hz);
}

static PyObject *
path_blame(Path *self, PyObject *stamp)
{
    int64_t at = 0, worst_oldest = 0, worst_newest = 0;
    Py_ssize_t young = -1, empty = -1, behind = -1;
    bool latest = stamp == Py_None;
    if (!latest && !plain_stamp(stamp, &at))
        Py_RETURN_NONE;
    for (Py_ssize_t i = 0; i < track_count(self); i++) {
        const History *history = (History *)PyTuple_GET_ITEM(self->histories, i);
        if (is_empty(history)) {
            empty = empty < 0 ? i : empty;
            continue;
        }
        int64_t oldest = history->block->stamps[history->first], newest = newest_of(history);
        if (at < oldest && (young < 0 || oldest >= worst_oldest)) {
            young = i;
            worst_oldest = oldest;
        }
        if (at > newest && (behind < 0 || newest < worst_newest)) {
            behind = i;
            worst_newest = newest;
        }
    }
    if (young >= 0 && !latest)
        return failure_of(self, IN_PAST, young, stamp);
    if (empty >= 0)
        return failure_of(self, NO_DATA, empty, stamp);
    if (behind >= 0 && !latest)
        return failure_of(self, IN_FUTURE, behind, stamp);
    Py_RETURN_NONE;
}

/* poses(stamps, out, valid): a batch, without the GIL. */

typedef struct {
    Window *windows;
    Between *nows;
    Py_ssize_t tracks;
    int64_t oldest; /* the instants between these two can be answered */
    int64_t newest;
} Batch;

static void
batch_release(Batch *batch)
{
    for (Py_ssize_t i = 0; batch->windows != NULL && i < batch->tracks; i++)
        Py_DECREF((PyObject *)batch->windows[i].block);
    PyMem_Free(batch->windows);
    PyMem_Free(batch->nows);
}

/* Takes the windows of all tracks at one moment, with references to their blocks. */
static int
batch_begin(const Path *self, Batch *batch)
{
    Py_ssize_t tracks = track_count(self);
    batch->tracks = tracks;
    batch->oldest = INT64_MIN;
    batch->newest = INT64_MAX;
    batch->windows = PyMem_New(Window, (size_t)tracks + 1);
    batch->nows = PyMem_New(Between, (size_t)tracks + 1);
    if (batch->windows == NULL || batch->nows == NULL) {
        PyMem_Free(batch->windows);
        PyMem_Free(batch->nows);
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < tracks; i++) {
        Window window = window_of(self, i);
        batch->windows[i] = window;
        Py_INCREF((PyObject *)window.block);
        if (window.first == window.end) {
            batch->newest = INT64_MIN;
            batch->oldest = INT64_MAX;
            continue;
        }
        int64_t oldest = window.block->stamps[window.first], newest = window.block->stamps[window.end - 1];
        batch->oldest = oldest > batch->oldest ? oldest : batch->oldest;
        batch->newest = newest < batch->newest ? newest : batch->newest;
    }
    return 0;
}

static bool
batch_pose(const Path *self, const Batch *batch, int64_t at, Pose *pose)
{
    if (at < batch->oldest || at > batch->newest)
        return false;
    for (Py_ssize_t i = 0; i < batch->tracks; i++)
        if (!rows_around(&batch->windows[i], at, &batch->nows[i]))
            return false;
    *pose = pose_at(self, batch->nows);
    if (batch->tracks != 0)
        *pose = normalized(*pose);
    return true;
}

static void
batch_run(const Path *self, const Batch *batch, const int64_t *stamps, Py_ssize_t count, double *out,
          char *valid)
{
    const Pose unknown = {Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN};
    for (Py_ssize_t i = 0; i < count; i++) {
        Pose pose = unknown;
        valid[i] = batch_pose(self, batch, stamps[i], &pose);
        memcpy(out + 7 * i, &pose, sizeof(pose));
    }
}

static PyObject *
poses_into(const Path *self, const Py_buffer *stamps, const Py_buffer *out, const Py_buffer *valid)
{
    Py_ssize_t count = count_of(stamps);
    Batch batch;
    if (count_of(out) % 7 != 0 || count_of(out) / 7 != count || valid->len != count) {
        PyErr_SetString(PyExc_ValueError, "each stamp has seven numbers in out and a byte in valid");
        return NULL;
    }
    if (batch_begin(self, &batch) < 0)
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    batch_run(self, &batch, stamps->buf, count, out->buf, valid->buf);
    Py_END_ALLOW_THREADS
    batch_release(&batch);
    Py_RETURN_NONE;
}

static PyObject *
path_poses(Path *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer stamps, out, valid;
    PyObject *done = NULL;
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "poses(stamps, out, valid)");
        return NULL;
    }
    if (get_stamps(args[0], &stamps) < 0)
        return NULL;
    if (get_doubles(args[1], &out, PyBUF_WRITABLE) == 0) {
        if (PyObject_GetBuffer(args[2], &valid, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) == 0) {
            done = poses_into(self, &stamps, &out, &valid);
            PyBuffer_Release(&valid);
        }
        PyBuffer_Release(&out);
    }
    PyBuffer_Release(&stamps);
    return done;
}

static int
path_read_steps(Path *self, PyObject *to_target, PyObject *to_source, const Py_ssize_t *widths)
{
    self->to_target = PyTuple_GET_SIZE(to_target);
    self->to_source = PyTuple_GET_SIZE(to_source);
    Py_ssize_t count = self->to_target + self->to_source;
    self->steps = PyMem_New(Step, (size_t)count + 1);
    if (self->steps == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *description = i < self->to_target ? PyTuple_GET_ITEM(to_target, i)
                                                    : PyTuple_GET_ITEM(to_source, i - self->to_target);
        if (read_step(description, &self->steps[i]) < 0 ||
            check_step(&self->steps[i], track_count(self), widths) < 0)
            return -1;
    }
    return 0;
}

static int
path_fill(Path *self, PyObject *to_target, PyObject *to_source)
{
    Py_ssize_t tracks = track_count(self);
    Py_ssize_t *widths = PyMem_New(Py_ssize_t, (size_t)tracks + 1);
    if (widths == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < tracks; i++) {
        PyObject *history = PyTuple_GET_ITEM(self->histories, i);
        if (!PyObject_TypeCheck(history, &History_type)) {
            PyErr_SetString(PyExc_TypeError, "a path passes histories");
            PyMem_Free(widths);
            return -1;
        }
        widths[i] = ((History *)history)->width;
    }
    int done = path_read_steps(self, to_target, to_source, widths);
    PyMem_Free(widths);
    return done;
}

static PyObject *
path_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"type", "target", "source", "to_target", "to_source", "histories", NULL};
    PyTypeObject *answers;
    PyObject *target, *source, *to_target, *to_source, *histories;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!OOO!O!O!:Path", names, &PyType_Type, &answers, &target,
                                     &source, &PyTuple_Type, &to_target, &PyTuple_Type, &to_source,
                                     &PyTuple_Type, &histories))
        return NULL;
    if (!PyType_IsSubtype(answers, &Facts_type)) {
        PyErr_SetString(PyExc_TypeError, "answers are of a type that derives from Facts");
        return NULL;
    }
    Path *self = (Path *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    Py_INCREF(answers);
    Py_INCREF(target);
    Py_INCREF(source);
    Py_INCREF(histories);
    self->type = answers;
    self->target = target;
    self->source = source;
    self->histories = histories;
    if (path_fill(self, to_target, to_source) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static void
path_dealloc(Path *self)
{
    Py_XDECREF((PyObject *)self->type);
    Py_XDECREF(self->target);
    Py_XDECREF(self->source);
    Py_XDECREF(self->histories);
    PyMem_Free(self->steps);
    Py_TYPE(self)->tp_free(self);
}

static PyMethodDef path_methods[] = {
    {"at", (PyCFunction)(void (*)(void))path_at, METH_FASTCALL,
     "at(stamp=None): the Transform, or None where the reference has to be asked."},
    {"blame", (PyCFunction)path_blame, METH_O,
     "blame(stamp): (failure, track, stamp, oldest, newest, rate_hz), or None when there is none."},
    {"poses", (PyCFunction)(void (*)(void))path_poses, METH_FASTCALL,
     "poses(stamps, out, valid): many at once; NaN and False where there is no answer."},
    {NULL},
};

static PyTypeObject Path_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.Path",
    .tp_doc = "The way between two frames, compiled.",
    .tp_basicsize = sizeof(Path),
    .tp_new = path_new,
    .tp_dealloc = (destructor)path_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = path_methods,
};

/* ------------------------------------------------------------------------------------------------
 * The module
 */

static PyMethodDef kernel_methods[] = {
    {"insert_together", insert_together, METH_VARARGS,
     "insert_together(histories, stamp, rows): one instant of several histories, at one moment."},
    {NULL},
};

static struct PyModuleDef kernel_module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "zstate._kernel",
    .m_doc = "The hot loops of the buffer. zstate.extension says whether they are used.",
    .m_size = -1,
    .m_methods = kernel_methods,
};

static int
fill_module(PyObject *module)
{
    PyTypeObject *types[] = {&Block_type, &History_type, &Facts_type, &Path_type};
    for (size_t i = 0; i < sizeof(types) / sizeof(types[0]); i++)
        if (PyModule_AddType(module, types[i]) < 0)
            return -1;
    kind_static = PyUnicode_InternFromString("static");
    kind_exact = PyUnicode_InternFromString("exact");
    kind_interpolated = PyUnicode_InternFromString("interpolated");
    if (kind_static == NULL || kind_exact == NULL || kind_interpolated == NULL)
        return -1;
    return PyModule_AddIntConstant(module, "REVISION", REVISION);
}

PyMODINIT_FUNC
PyInit__kernel(void)
{
    PyObject *module = PyModule_Create(&kernel_module);
    if (module != NULL && fill_module(module) < 0)
        Py_CLEAR(module);
    return module;
}
