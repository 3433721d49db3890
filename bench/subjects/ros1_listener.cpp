// A tf2_ros listener in C++ that calls back when its buffer answers; a library, so that it can run in the harness's
// reader process. All functions but ros1_listen are for any thread. Compiled as ros1.py sets.
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <tf2_msgs/TFMessage.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <iterator>
#include <memory>
#include <string>
#include <thread>

namespace {

using Answered = void (*)(std::int64_t stamp);

constexpr int kQueue = 100; // what tf2_ros's listener has

struct Listener {
    Listener(const char *base, const char *tip, Answered answered)
        : base_(base), tip_(tip), answered_(answered),
          listener_(buffer_, node_, false, ros::TransportHints().tcpNoDelay()),
          // Callbacks of a topic are queued in the order of their subscription, and one thread serves them.
          woken_(node_.subscribe("/tf", kQueue, &Listener::take, this, ros::TransportHints().tcpNoDelay())),
          thread_([this] {
              while (!is_closed_)
                  ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.1));
          }) {}

    ~Listener() {
        is_closed_ = true;
        thread_.join();
    }

    geometry_msgs::Transform lookup(std::int64_t stamp) const {
        ros::Time time;
        return buffer_.lookupTransform(base_, tip_, time.fromNSec(static_cast<std::uint64_t>(stamp))).transform;
    }

    void take(const tf2_msgs::TFMessage::ConstPtr &message) {
        const auto stamp = static_cast<std::int64_t>(message->transforms.front().header.stamp.toNSec());
        try {
            lookup(stamp);
        } catch (const tf2::TransformException &) {
            return; // static edges may come after moving ones; what is never answered is counted as lost
        }
        answered_(stamp);
    }

    ros::NodeHandle node_;
    tf2_ros::Buffer buffer_;
    std::string base_, tip_;
    Answered answered_;
    tf2_ros::TransformListener listener_;
    ros::Subscriber woken_;
    std::atomic<bool> is_closed_{false};
    std::thread thread_;
};

std::unique_ptr<Listener> listener;

} // namespace

extern "C" {

void ros1_listen(const char *base, const char *tip, Answered answered) {
    using ros::init_options::AnonymousName, ros::init_options::NoRosout, ros::init_options::NoSigintHandler;
    ros::init(ros::M_string(), "bench", NoSigintHandler | AnonymousName | NoRosout);
    ros::start();
    listener = std::make_unique<Listener>(base, tip, answered);
}

// x y z qx qy qz qw of the tip in the base; false when the buffer has no answer.
bool ros1_pose(std::int64_t stamp, double *pose) {
    try {
        const auto found = listener->lookup(stamp);
        const auto &t = found.translation;
        const auto &q = found.rotation;
        const double numbers[] = {t.x, t.y, t.z, q.x, q.y, q.z, q.w};
        std::copy(std::begin(numbers), std::end(numbers), pose);
        return true;
    } catch (const tf2::TransformException &) {
        return false;
    }
}

bool ros1_knows(const char *link) {
    return listener->buffer_.canTransform(listener->base_, link, ros::Time(0));
}

void ros1_close() {
    listener.reset();
    ros::shutdown();
}

} // extern "C"
