// laser_geometry with a tf2 buffer, for laser_geometry.py.

#include <cstdint>
#include <cstring>
#include <vector>

#include <geometry_msgs/TransformStamped.h>
#include <laser_geometry/laser_geometry.h>
#include <sensor_msgs/LaserScan.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2/buffer_core.h>

namespace {

ros::Time time_of(std::int64_t stamp) {
    ros::Time time;
    return time.fromNSec(static_cast<std::uint64_t>(stamp));
}

struct Projector {
    tf2::BufferCore buffer{ros::Duration(60.0)};
    laser_geometry::LaserProjection projection;
    sensor_msgs::LaserScan scan;
    sensor_msgs::PointCloud2 cloud;
};

}  // namespace

extern "C" {

Projector *projector_new() { return new Projector; }

void projector_delete(Projector *self) { delete self; }

// pose: x y z qx qy qz qw of `child` in `parent`.
void projector_add(Projector *self, const char *parent, const char *child, std::int64_t stamp,
                   const double *pose, int is_static) {
    geometry_msgs::TransformStamped one;
    one.header.frame_id = parent;
    one.header.stamp = time_of(stamp);
    one.child_frame_id = child;
    one.transform.translation.x = pose[0];
    one.transform.translation.y = pose[1];
    one.transform.translation.z = pose[2];
    one.transform.rotation.x = pose[3];
    one.transform.rotation.y = pose[4];
    one.transform.rotation.z = pose[5];
    one.transform.rotation.w = pose[6];
    self->buffer.setTransform(one, "bench", is_static != 0);
}

// A full turn of `count` rays, the last of them `turn_s` after the first.
void projector_set_scan(Projector *self, const char *frame, std::int64_t stamp, double turn_s,
                        std::int64_t count, const float *ranges, const double *angles) {
    sensor_msgs::LaserScan &scan = self->scan;
    scan.header.frame_id = frame;
    scan.header.stamp = time_of(stamp);
    scan.angle_min = static_cast<float>(angles[0]);
    scan.angle_increment = static_cast<float>(angles[1]);
    scan.angle_max = static_cast<float>(angles[0] + angles[1] * static_cast<double>(count - 1));
    scan.time_increment = static_cast<float>(turn_s / static_cast<double>(count - 1));
    scan.range_min = 0.0F;
    scan.range_max = 100.0F;
    scan.ranges.assign(ranges, ranges + count);
}

void projector_place(Projector *self, const char *target) {
    self->projection.transformLaserScanToPointCloud(target, self->scan, self->cloud, self->buffer, -1.0,
                                                    laser_geometry::channel_option::Index);
}

// Copies at most `count` points (x y z each) and returns how many the cloud has.
std::int64_t projector_points(const Projector *self, std::int64_t count, float *points) {
    std::int64_t placed = static_cast<std::int64_t>(self->cloud.width) * self->cloud.height;
    for (std::int64_t i = 0; i < placed && i < count; i++)
        std::memcpy(points + 3 * i, &self->cloud.data[static_cast<std::size_t>(i) * self->cloud.point_step],
                    3 * sizeof(float));
    return placed;
}
}
