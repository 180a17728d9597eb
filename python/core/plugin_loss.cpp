#include "python/core/plugin_loss.h"

#include <pybind11/stl.h>

#include <vector>

#include "python/core/arrays.h"
#include "python/core/plugin_calls.h"

namespace semfield::python {

namespace {

class PythonLoss final : public Loss {
 public:
  PythonLoss(const std::string& name, const py::object& type, const PythonParams& params)
      : owner_("loss '" + name + "'") {
    called(owner_, [&] {
      const py::object made = type.attr("_made")(params.values());
      rule_.weight = made.attr("weight").cast<double>();
      rule_.from_step = made.attr("from_step").cast<double>();
      targets_ = made.attr("targets").cast<std::vector<std::string>>();
      heads_ = made.attr("heads").cast<std::vector<std::string>>();
      moves_ = made.attr("moves").cast<std::vector<std::string>>();
      instance_ = hold(made);
    });
    if (moves_.empty())
      throw Error(ErrorKind::usage, "plugin.python.moves",
                  owner_ + ": moves names no channel that it has a gradient of");
    traits_.targets.assign(targets_.begin(), targets_.end());
    traits_.heads.assign(heads_.begin(), heads_.end());
    traits_.moves.assign(moves_.begin(), moves_.end());
  }

  LossRule rule() const override { return rule_; }
  LossTraits traits() const override { return traits_; }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override {
    return called(owner_ + ".counted",
                  [&] { return instance_->attr("counted")(arrays(batch), rays).cast<std::int64_t>(); });
  }
  double add(const RayTargets& targets, const RayValues<float>& values, double scale,
             const RayGradients<float>& gradients) const override {
    return add_real(targets, values, scale, gradients);
  }
  double add(const RayTargets& targets, const RayValues<double>& values, double scale,
             const RayGradients<double>& gradients) const override {
    return add_real(targets, values, scale, gradients);
  }
  LossKernel kernel(Device device, std::string_view owner, const KernelTables&) const override {
    throw Error(
        ErrorKind::unavailable, "plugin.kernels.missing",
        std::string(owner) + " is written in Python and has no " + std::string(device_name(device)) + " kernels");
  }

 private:
  template <class T>
  static void put(py::dict& out, std::string_view name, View<T> view) {
    if (view.cols > 0) out[py::str(std::string(name))] = borrowed(view);
  }
  static py::dict arrays(const RayTargets& targets) {
    py::dict out;
    put(out, channel::color, targets.color);
    put(out, channel::label, targets.label);
    for (const auto& one : targets.more) put(out, one.name, one.view);
    return out;
  }
  template <class Real>
  static py::dict arrays(const RayValues<Real>& values) {
    py::dict out;
    put(out, "near_far", values.near_far);
    put(out, "first", values.first);
    put(out, "t", values.t);
    put(out, "delta", values.delta);
    put(out, channel::sigma, values.sigma);
    put(out, channel::weight, values.weight);
    put(out, channel::color, values.color);
    put(out, channel::depth, values.depth);
    put(out, channel::opacity, values.opacity);
    for (const auto& one : values.heads) put(out, one.name, one.view);
    return out;
  }
  template <class Real>
  static View<Real> gradient_of(const RayGradients<Real>& gradients, std::string_view name) {
    if (name == channel::color) return gradients.color;
    if (name == channel::depth) return gradients.depth;
    if (name == channel::weight) return gradients.weight;
    if (name == channel::sigma) return gradients.sigma;
    return gradients.heads[name];
  }

  template <class Real>
  double add_real(const RayTargets& targets, const RayValues<Real>& values, double scale,
                  const RayGradients<Real>& gradients) const {
    if (values.first.rows <= 1) return 0;
    return called(owner_ + ".value", [&] {
      const auto answer = instance_->attr("value")(arrays(targets), arrays(values)).template cast<py::tuple>();
      if (answer.size() != 2)
        throw Error(ErrorKind::failure, "plugin.python.value",
                    owner_ + ".value: expected a loss and a dict of gradients");
      for (const auto& [key, gradient] : answer[1].template cast<py::dict>())
        add_gradient(py::str(key).cast<std::string>(), gradient, scale, gradients);
      return answer[0].attr("sum")().template cast<double>();
    });
  }
  template <class Real>
  void add_gradient(const std::string& name, const py::handle& given, double scale,
                    const RayGradients<Real>& gradients) const {
    const View<Real> to = gradient_of(gradients, name);
    const std::string what = owner_ + ".value: gradient of '" + name + "'";
    if (!traits_.does_move(name))
      throw Error(ErrorKind::failure, "plugin.python.moves", what + ", which `moves` does not name");
    if (to.empty()) return;
    const auto array = py::array_t<double, py::array::c_style | py::array::forcecast>::ensure(given);
    if (!array || array.ndim() != 2 || array.shape(0) > to.rows || array.shape(1) != to.cols) {
      PyErr_Clear();
      throw Error(
          ErrorKind::failure, "plugin.python.shape",
          what + ": expected an array of the shape (" + std::to_string(to.rows) + ", " + std::to_string(to.cols) + ")");
    }
    const auto rows = array.template unchecked<2>();
    for (py::ssize_t r = 0; r < array.shape(0); ++r) {
      for (std::int32_t c = 0; c < to.cols; ++c) to(r, c) += static_cast<Real>(scale * rows(r, c));
    }
  }

  std::string owner_;
  LossRule rule_;
  std::vector<std::string> targets_, heads_, moves_;
  LossTraits traits_;
  Held instance_;
};

}  // namespace

std::unique_ptr<Loss> make_python_loss(const std::string& name, const py::object& type, const PythonParams& params) {
  return std::make_unique<PythonLoss>(name, type, params);
}

}  // namespace semfield::python
