/* The hot loops of the buffer: histories of samples, and compiled paths over them; and those of the
 * publisher.
 *
 * Each type is specified by its reference in Python, which stays complete:
 * zstate/buffer/history.py (History), path.py and interpolation.py (Path), waiting.py
 * (NewerTransforms), zstate/transform.py (TransformFields), zstate/model/joint_transforms.py
 * (Edges), zstate/model/pinocchio_solver.py (placement_poses), zstate/nodes/publisher.py
 * (JointStateEncoder, PublishPath), zstate/wire/ros2/encoder.py (RosJointStateEncoder),
 * zstate/net/sample_history.py (SampleRing), zstate/ingest/base.py with zstate/wire/native.py and
 * zstate/wire/ros2/decoder.py (FastPath). Differences to those are bugs, and tests compare both.
 *
 * Threads. All writes and all changes of references need the GIL. The rows of a block that a window
 * covers are never written again, so a batch that holds references to its blocks reads them without
 * the GIL. A call with the GIL sees all histories between two inserts, because an insert, also one
 * into several histories (insert_together), runs no Python code between its first write and its
 * last.
 *
 * All arguments are checked on entry (formats, sizes, columns, kinds), so that none can make the
 * code below read or write outside of its memory.
 */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

#include "_kernel/input.h"
#include "_kernel/block.h"
#include "_kernel/history.h"
#include "_kernel/ros_message.h"
#include "_kernel/fast_path.h"
#include "_kernel/motion.h"
#include "_kernel/transform_fields.h"
#include "_kernel/step.h"
#include "_kernel/lanes.h"
#include "_kernel/path.h"
#include "_kernel/curve.h"
#include "_kernel/place.h"
#include "_kernel/newer_transforms.h"
#include "_kernel/edges.h"
#include "_kernel/placements.h"
#include "_kernel/joint_state.h"
#include "_kernel/ros_joint_state.h"
#include "_kernel/sample_ring.h"
#include "_kernel/publish_path.h"

/* Raised with every change of the interface to Python, so that a library built from older source
 * (an editable install that was not rebuilt) is recognised and not used. */
#define REVISION 12

static PyMethodDef kernel_methods[] = {
    {"insert_together", insert_together, METH_VARARGS,
     "insert_together(histories, stamp, rows): one instant of several histories, at one moment."},
    {"placement_poses", (PyCFunction)(void (*)(void))placement_poses, METH_FASTCALL,
     "placement_poses(placements, rows, parents, poses): parent * placement of each row."},
    {NULL},
};

static struct PyModuleDef kernel_module = {
    PyModuleDef_HEAD_INIT, .m_name = "zstate._kernel",  .m_doc = "The hot loops of the buffer.",
    .m_size = -1,          .m_methods = kernel_methods,
};

static int
fill_module(PyObject *module)
{
    PyTypeObject *types[] = {&Block_type,
                             &History_type,
                             &FastPath_type,
                             &TransformFields_type,
                             &Path_type,
                             &NewerTransforms_type,
                             &Edges_type,
                             &JointStateEncoder_type,
                             &SampleRing_type,
                             &PublishPath_type,
                             &RosJointStateEncoder_type};
    for (size_t i = 0; i < sizeof(types) / sizeof(types[0]); i++)
        if (PyModule_AddType(module, types[i]) < 0)
            return -1;
    kind_static = PyUnicode_InternFromString("static");
    kind_exact = PyUnicode_InternFromString("exact");
    kind_interpolated = PyUnicode_InternFromString("interpolated");
    version_name = PyUnicode_InternFromString("version");
    received_name = PyUnicode_InternFromString("received");
    no_waiters = PyTuple_New(0);
    attachment_names = Py_BuildValue("(s)", "attachment");
    if (kind_static == NULL || kind_exact == NULL || kind_interpolated == NULL ||
        version_name == NULL || received_name == NULL || no_waiters == NULL ||
        attachment_names == NULL)
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
