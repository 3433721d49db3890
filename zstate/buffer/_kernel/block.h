/* Block: memory of one history, stamps first and rows behind them. A read-only buffer of bytes. */

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
        memcpy(to->rows + (size_t)at * width, from->rows + (size_t)first * width,
               count * width * 8);
}

static PyBufferProcs block_as_buffer = {.bf_getbuffer = (getbufferproc)block_getbuffer};

static PyMemberDef block_members[] = {
    {"capacity", T_PYSSIZET, offsetof(Block, capacity), READONLY,
     "How many samples there is room for."},
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
