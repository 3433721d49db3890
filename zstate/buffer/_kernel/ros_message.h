/* A JointState of ROS 2 with the attachment of rmw_zenoh behind it, for fast_path.h.
 *
 * CDR as in zstate/wire/ros2/cdr.py: a header of 4 bytes, the stamp, frame_id, names, and
 * positions, velocities and efforts, each value aligned to its size, counted from the fifth byte.
 * The attachment (zstate/wire/ros2/graph.py) is the sequence number, a time, 16 and the 16
 * bytes of the gid.
 */

#define CDR_HEADER_BYTES 4
#define CDR_STAMP_END 12
#define ATTACHMENT_BYTES 33
#define GID_LENGTH_AT 16
#define SEQUENCES 3

static bool
is_ros_message(const uint8_t *bytes, Py_ssize_t size)
{
    static const uint8_t little_endian[CDR_HEADER_BYTES] = {0, 1, 0, 0};
    return size >= CDR_STAMP_END + ATTACHMENT_BYTES &&
           memcmp(bytes, little_endian, CDR_HEADER_BYTES) == 0;
}

/* The stamp and the seq; *at is behind the stamp. */
static bool
read_ros_head(const uint8_t *bytes, Py_ssize_t size, Py_ssize_t *at, int64_t *stamp, int64_t *seq)
{
    const uint8_t *attachment = bytes + size - ATTACHMENT_BYTES;
    int32_t seconds;
    uint32_t nanoseconds;
    memcpy(&seconds, bytes + CDR_HEADER_BYTES, sizeof seconds);
    memcpy(&nanoseconds, bytes + CDR_HEADER_BYTES + sizeof seconds, sizeof nanoseconds);
    memcpy(seq, attachment, sizeof *seq);
    *stamp = (int64_t)seconds * 1000000000 + nanoseconds;
    *at = CDR_STAMP_END;
    return nanoseconds < 1000000000 && attachment[GID_LENGTH_AT] == 16;
}

static bool
read_cdr_count(const uint8_t *bytes, Py_ssize_t end, Py_ssize_t *at, Py_ssize_t *count)
{
    uint32_t raw;
    *at += (CDR_HEADER_BYTES - *at) & 3;
    if (end - *at < (Py_ssize_t)sizeof raw)
        return false;
    memcpy(&raw, bytes + *at, sizeof raw);
    *at += sizeof raw;
    *count = (Py_ssize_t)raw;
    return *count <= end - *at; /* each item has at least a byte */
}

static bool
skip_cdr_text(const uint8_t *bytes, Py_ssize_t end, Py_ssize_t *at)
{
    Py_ssize_t length;
    if (!read_cdr_count(bytes, end, at, &length))
        return false;
    *at += length;
    return true;
}

/* Where the numbers of the sequences begin, and their counts, up to the first empty sequence: the
 * number of sequences, 0 for bytes that are no such message. */
static int
read_ros_sequences(const uint8_t *bytes, Py_ssize_t size, Py_ssize_t *starts, Py_ssize_t *counts)
{
    Py_ssize_t end = size - ATTACHMENT_BYTES, at = CDR_STAMP_END, names;
    if (!skip_cdr_text(bytes, end, &at) || !read_cdr_count(bytes, end, &at, &names))
        return 0;
    for (Py_ssize_t i = 0; i < names; i++)
        if (!skip_cdr_text(bytes, end, &at))
            return 0;
    for (int i = 0; i < SEQUENCES; i++) {
        if (!read_cdr_count(bytes, end, &at, &counts[i]))
            return 0;
        if (counts[i] == 0)
            return i;
        at += (CDR_HEADER_BYTES - at) & 7;
        if (at > end || counts[i] > (end - at) / 8)
            return 0;
        starts[i] = at;
        at += 8 * counts[i];
    }
    return SEQUENCES;
}
