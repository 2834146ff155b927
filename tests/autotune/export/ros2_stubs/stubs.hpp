// Stubs of exactly what the exported package uses of ROS 2, written from the public interfaces, none of their code:
// ros2_control (controller_interface, hardware_interface) 2.x of Humble, 4.x of Jazzy and later, realtime_tools 2.x to 4.x,
// kinematics_interface 0.x (Humble) and 1.x, pluginlib 5, rclcpp 16 (Humble), 28 (Jazzy) and later, diagnostic_msgs and
// geometry_msgs, Eigen 3.4. STUB_RCLCPP_MAJOR chooses; from 29 on the deprecated names are gone.
#ifndef STUBS_HPP_
#define STUBS_HPP_

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#define RCLCPP_VERSION_MAJOR STUB_RCLCPP_MAJOR
#define STUB_IS_HUMBLE (STUB_RCLCPP_MAJOR < 18)
#define STUB_IS_LATER (STUB_RCLCPP_MAJOR > 28)

// ---- Eigen: the members that are used, with their sizes
namespace Eigen
{
using Index = std::ptrdiff_t;

class VectorXd
{
public:
  void setZero(Index size) { values_.assign(static_cast<std::size_t>(size), 0.0); }
  Index size() const { return static_cast<Index>(values_.size()); }
  double & operator[](Index i) { return values_.at(static_cast<std::size_t>(i)); }
  double operator[](Index i) const { return values_.at(static_cast<std::size_t>(i)); }

private:
  std::vector<double> values_;
};

template <class Number, int Rows, int Columns>
class Matrix
{
public:
  Number & operator[](Index i) { return values_.at(static_cast<std::size_t>(i)); }
  Number operator[](Index i) const { return values_.at(static_cast<std::size_t>(i)); }
  Number & operator()(Index row, Index column) { return values_.at(static_cast<std::size_t>(Columns * row + column)); }
  Number operator()(Index row, Index column) const { return values_.at(static_cast<std::size_t>(Columns * row + column)); }

private:
  std::array<Number, static_cast<std::size_t>(Rows * Columns)> values_{};
};

class Isometry3d
{
public:
  Matrix<double, 3, 1> & translation() { return translation_; }
  Matrix<double, 3, 3> & linear() { return linear_; }

private:
  Matrix<double, 3, 1> translation_;
  Matrix<double, 3, 3> linear_;
};
}  // namespace Eigen

// ---- messages
namespace geometry_msgs::msg
{
struct Vector3 { double x = 0.0, y = 0.0, z = 0.0; };
struct Wrench { Vector3 force, torque; };
struct WrenchStamped
{
  using SharedPtr = std::shared_ptr<WrenchStamped>;
  Wrench wrench;
};
}  // namespace geometry_msgs::msg

namespace rclcpp
{
class Time {};

class Duration
{
public:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds() const { return seconds_; }

private:
  double seconds_;
};
}  // namespace rclcpp

namespace diagnostic_msgs::msg
{
struct Stamp { Stamp & operator=(const rclcpp::Time &) { return *this; } };
struct Header { Stamp stamp; std::string frame_id; };
struct KeyValue { std::string key, value; };
struct DiagnosticStatus
{
  static constexpr unsigned char OK = 0, WARN = 1, ERROR = 2, STALE = 3;
  unsigned char level = OK;
  std::string name, message, hardware_id;
  std::vector<KeyValue> values;
};
struct DiagnosticArray { Header header; std::vector<DiagnosticStatus> status; };
}  // namespace diagnostic_msgs::msg

// ---- rclcpp
#define RCLCPP_ERROR(logger, ...) stub::say(logger, __VA_ARGS__)
#define RCLCPP_INFO(logger, ...) stub::say(logger, __VA_ARGS__)
namespace stub
{
struct Logger {};
void say(Logger, const char * format, ...) __attribute__((format(printf, 2, 3)));
extern diagnostic_msgs::msg::DiagnosticArray published;
extern int publications;
extern std::function<void(geometry_msgs::msg::WrenchStamped::SharedPtr)> heard;
}  // namespace stub

namespace rclcpp
{
class SystemDefaultsQoS {};
namespace node_interfaces { class NodeParametersInterface {}; }

template <class Message>
class Publisher
{
public:
  using SharedPtr = std::shared_ptr<Publisher>;
};

template <class Message>
class Subscription
{
public:
  using SharedPtr = std::shared_ptr<Subscription>;
};
}  // namespace rclcpp

namespace rclcpp_lifecycle
{
class State {};

class LifecycleNode
{
public:
  const char * get_name() const { return "admittance_controller"; }
  stub::Logger get_logger() const { return {}; }
  std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface> get_node_parameters_interface() { return nullptr; }

  template <class Message>
  typename rclcpp::Publisher<Message>::SharedPtr create_publisher(const std::string &, const rclcpp::SystemDefaultsQoS &)
  {
    return std::make_shared<rclcpp::Publisher<Message>>();
  }

  template <class Message, class Callback>
  typename rclcpp::Subscription<Message>::SharedPtr create_subscription(
    const std::string &, const rclcpp::SystemDefaultsQoS &, Callback && callback)
  {
    stub::heard = callback;
    return std::make_shared<rclcpp::Subscription<Message>>();
  }
};
}  // namespace rclcpp_lifecycle

// ---- realtime_tools
namespace realtime_tools
{
template <class Value>
class RealtimeBuffer
{
public:
  void writeFromNonRT(const Value & value) { value_ = value; }
  Value * readFromRT() { return &value_; }

private:
  Value value_{};
};

template <class Message>
class RealtimePublisher
{
public:
  explicit RealtimePublisher(typename rclcpp::Publisher<Message>::SharedPtr) {}
#if STUB_IS_LATER
  bool try_publish(const Message & message)
  {
    message_ = message;
    stub::published = message_;
    ++stub::publications;
    return true;
  }

private:
  Message message_;
#else
  bool trylock() { return true; }
  void unlockAndPublish()
  {
    stub::published = msg_;
    ++stub::publications;
  }
  Message msg_;
#endif
};
}  // namespace realtime_tools

// ---- hardware_interface
namespace hardware_interface
{
constexpr char HW_IF_POSITION[] = "position";
constexpr char HW_IF_VELOCITY[] = "velocity";

class CommandInterface
{
public:
  CommandInterface(const std::string & prefix, const std::string & name, double * value)
  : name_(prefix + "/" + name), value_(value) {}
  const std::string & get_name() const { return name_; }
  double * stub_value() const { return value_; }

private:
  std::string name_;
  double * value_;
};

class LoanedStateInterface
{
public:
  LoanedStateInterface(std::string name, double * value) : name_(std::move(name)), value_(value) {}
  const std::string & get_name() const { return name_; }
#if STUB_IS_LATER
  template <class Number = double>
  std::optional<Number> get_optional() const { return *value_; }
#else
  double get_value() const { return *value_; }
#endif
  double stub_value() const { return *value_; }

private:
  std::string name_;
  double * value_;
};

class LoanedCommandInterface
{
public:
  LoanedCommandInterface(std::string name, double * value) : name_(std::move(name)), value_(value) {}
#if STUB_IS_HUMBLE
  void set_value(double value) { *value_ = value; }
#else
  [[nodiscard]] bool set_value(double value)
  {
    *value_ = value;
    return std::isfinite(value);
  }
#endif

private:
  std::string name_;
  double * value_;
};
}  // namespace hardware_interface

// ---- controller_interface
namespace controller_interface
{
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration
{
  interface_configuration_type type = interface_configuration_type::NONE;
  std::vector<std::string> names;
};

class ControllerInterfaceBase
{
public:
  virtual ~ControllerInterfaceBase() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }
  unsigned int get_update_rate() const { return stub_update_rate; }
#if !STUB_IS_HUMBLE
  const std::string & get_robot_description() const { return description_; }
#endif
  unsigned int stub_update_rate = 0;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;

private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>();
  std::string description_;
};

class ChainableControllerInterface : public ControllerInterfaceBase
{
public:
  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period)
  {
    if (!chained_) {
#if STUB_IS_HUMBLE
      const auto found = update_reference_from_subscribers();
#else
      const auto found = update_reference_from_subscribers(time, period);
#endif
      if (found != return_type::OK) {
        return found;
      }
    }
    return update_and_write_commands(time, period);
  }
  std::vector<hardware_interface::CommandInterface> export_reference_interfaces() { return on_export_reference_interfaces(); }
  bool set_chained_mode(bool chained)
  {
    chained_ = chained;
    return on_set_chained_mode(chained);
  }

protected:
  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual bool on_set_chained_mode(bool) { return true; }
#if STUB_IS_HUMBLE
  virtual return_type update_reference_from_subscribers() = 0;
#else
  virtual return_type update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) = 0;
#endif
  virtual return_type update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  std::vector<double> reference_interfaces_;

private:
  bool chained_ = false;
};
}  // namespace controller_interface

// ---- semantic_components
namespace semantic_components
{
class ForceTorqueSensor
{
public:
  explicit ForceTorqueSensor(std::string name) : name_(std::move(name)) {}
  bool assign_loaned_state_interfaces(std::vector<hardware_interface::LoanedStateInterface> & all)
  {
    found_.clear();
    for (const char * const each : {"force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z"}) {
      for (const auto & state : all) {
        if (state.get_name() == name_ + "/" + each) {
          found_.push_back(&state);
        }
      }
    }
    return found_.size() == 6;
  }
  void release_interfaces() { found_.clear(); }
  std::array<double, 3> get_forces() const { return {{value(0), value(1), value(2)}}; }
  std::array<double, 3> get_torques() const { return {{value(3), value(4), value(5)}}; }

private:
  double value(std::size_t i) const { return found_.at(i)->stub_value(); }
  std::string name_;
  std::vector<const hardware_interface::LoanedStateInterface *> found_;
};
}  // namespace semantic_components

// ---- kinematics_interface, pluginlib
namespace kinematics_interface
{
class KinematicsInterface
{
public:
  virtual ~KinematicsInterface() = default;
#if STUB_IS_HUMBLE
  virtual bool initialize(
    std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface>, const std::string & end_effector_name) = 0;
#else
  virtual bool initialize(
    const std::string & robot_description, std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface>,
    const std::string & param_namespace) = 0;
#endif
  virtual bool convert_cartesian_deltas_to_joint_deltas(
    const Eigen::VectorXd & joint_pos, const Eigen::Matrix<double, 6, 1> & delta_x, const std::string & link_name,
    Eigen::VectorXd & delta_theta) = 0;
  virtual bool calculate_link_transform(
    const Eigen::VectorXd & joint_pos, const std::string & link_name, Eigen::Isometry3d & transform) = 0;
};
}  // namespace kinematics_interface

namespace stub
{
kinematics_interface::KinematicsInterface * new_kinematics();
}

namespace pluginlib
{
template <class Base>
class ClassLoader
{
public:
  ClassLoader(const std::string &, const std::string &) {}
  Base * createUnmanagedInstance(const std::string & name)
  {
    if (name.empty()) {
      throw std::runtime_error("no such plugin");
    }
    return stub::new_kinematics();
  }
};
}  // namespace pluginlib

#define PLUGINLIB_EXPORT_CLASS(Derived, Base) \
  static_assert(std::is_base_of<Base, Derived>::value, "a plugin derives from its base"); \
  extern "C" Base * stub_new_controller() { return new Derived(); }

#endif  // STUBS_HPP_
