// Drives the exported controller through its lifecycle by commands on standard input, one line of answer to each.
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <new>

#include "stubs.hpp"

namespace
{
long allocations = 0;
}

void * operator new(std::size_t size)
{
  ++allocations;
  if (void * found = std::malloc(size == 0 ? 1 : size)) {
    return found;
  }
  throw std::bad_alloc();
}
void operator delete(void * memory) noexcept { std::free(memory); }
void operator delete(void * memory, std::size_t) noexcept { std::free(memory); }

namespace stub
{
diagnostic_msgs::msg::DiagnosticArray published;
int publications = 0;
std::function<void(geometry_msgs::msg::WrenchStamped::SharedPtr)> heard;

void say(Logger, const char * format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  std::vfprintf(stderr, format, arguments);
  va_end(arguments);
  std::fputc('\n', stderr);
}

// Three slides along the axes of the base, then turns about x, y and z, in this order from the tip: R = Rz Ry Rx.
class Gantry : public kinematics_interface::KinematicsInterface
{
public:
#if STUB_IS_HUMBLE
  bool initialize(std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface>, const std::string & tip) override
  {
    return tip == "tool0";
  }
#else
  bool initialize(
    const std::string &, std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface>,
    const std::string & named) override
  {
    return named == "kinematics";
  }
#endif
  bool calculate_link_transform(
    const Eigen::VectorXd & q, const std::string & link, Eigen::Isometry3d & pose) override
  {
    if (q[0] > 100.0 || link != "ft_frame") {
      return false;
    }
    const double cx = std::cos(q[3]), sx = std::sin(q[3]), cy = std::cos(q[4]), sy = std::sin(q[4]);
    const double cz = std::cos(q[5]), sz = std::sin(q[5]);
    const double rows[3][3] = {
      {cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx},
      {sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx},
      {-sy, cy * sx, cy * cx}};
    for (int i = 0; i < 3; ++i) {
      pose.translation()[i] = q[i];
      for (int j = 0; j < 3; ++j) {
        pose.linear()(i, j) = rows[i][j];
      }
    }
    return true;
  }
  bool convert_cartesian_deltas_to_joint_deltas(
    const Eigen::VectorXd & q, const Eigen::Matrix<double, 6, 1> & x, const std::string & link,
    Eigen::VectorXd & change) override
  {
    const double cy = std::cos(q[4]), cz = std::cos(q[5]), sz = std::sin(q[5]);
    if (link != "ft_frame" || std::fabs(cy) < 1e-3) {
      return false;
    }
    for (int i = 0; i < 3; ++i) {
      change[i] = x[i];
    }
    // The rates of R = Rz Ry Rx from the angular velocity in the base.
    change[3] = (cz * x[3] + sz * x[4]) / cy;
    change[4] = -sz * x[3] + cz * x[4];
    change[5] = x[5] + std::sin(q[4]) * change[3];
    return true;
  }
};

kinematics_interface::KinematicsInterface * new_kinematics() { return new Gantry(); }
}  // namespace stub

extern "C" controller_interface::ChainableControllerInterface * stub_new_controller();

int main(int, char ** arguments)
{
  std::unique_ptr<controller_interface::ChainableControllerInterface> controller(stub_new_controller());
  controller->stub_update_rate = static_cast<unsigned int>(std::atoi(arguments[1]));
  std::array<double, 12> states{};
  std::array<double, 6> commands{};
  std::array<double, 6> references{};
  std::vector<hardware_interface::CommandInterface> exported;
  const rclcpp_lifecycle::State state;
  bool chained = false;
  std::string word;
  while (std::cin >> word) {
    int answer = 0;
    if (word == "init") {
      answer = static_cast<int>(controller->on_init());
    } else if (word == "configure") {
      answer = static_cast<int>(controller->on_configure(state));
      exported = controller->export_reference_interfaces();
      controller->state_interfaces_.clear();
      controller->command_interfaces_.clear();
      std::size_t i = 0;
      for (const auto & name : controller->state_interface_configuration().names) {
        controller->state_interfaces_.emplace_back(name, &states.at(i++));
      }
      i = 0;
      for (const auto & name : controller->command_interface_configuration().names) {
        controller->command_interfaces_.emplace_back(name, &commands.at(i++));
      }
    } else if (word == "activate") {
      for (auto & each : states) {
        std::cin >> each;
      }
      answer = static_cast<int>(controller->on_activate(state));
    } else if (word == "deactivate") {
      answer = static_cast<int>(controller->on_deactivate(state));
    } else if (word == "chain") {
      chained = true;
      answer = controller->set_chained_mode(true) ? 0 : 1;
    } else if (word == "update") {
      double period = 0.0;
      std::cin >> period;
      for (auto & each : states) {
        std::string said;
        std::cin >> said;
        each = std::strtod(said.c_str(), nullptr);
      }
      for (auto & each : references) {
        std::cin >> each;
      }
      if (chained) {
        for (std::size_t i = 0; i < references.size(); ++i) {
          *exported.at(i).stub_value() = references[i];
        }
      } else {
        auto said = std::make_shared<geometry_msgs::msg::WrenchStamped>();
        said->wrench.force = {references[0], references[1], references[2]};
        said->wrench.torque = {references[3], references[4], references[5]};
        stub::heard(said);
      }
      const long before = allocations;
      answer = static_cast<int>(controller->update(rclcpp::Time(), rclcpp::Duration(period)));
      const long taken = allocations - before;
      const auto & status = stub::published.status.front();
      std::printf("%d %ld %d %s", answer, taken, static_cast<int>(status.level), status.values.at(0).value.c_str());
      for (const double each : commands) {
        std::printf(" %.17g", each);
      }
      std::printf("\n");
      std::fflush(stdout);
      continue;
    }
    std::printf("%d\n", answer);
    std::fflush(stdout);
  }
  return 0;
}
