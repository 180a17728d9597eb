#include "python/core/plugin_loss.h"

#include <pybind11/stl.h>

#include <algorithm>
#include <vector>

#include "python/core/arrays.h"
#include "python/core/plugin_calls.h"
#include "python/core/plugin_tensors.h"

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
    // What it moves, it reads: a name that no head makes is refused before the run, and does not train nothing.
    const auto is_of_pass = [](const std::string& one) {
      return one == channel::color || one == channel::depth || one == channel::weight || one == channel::sigma;
    };
    for (const std::string& moved : moves_)
      if (!is_of_pass(moved) && std::find(heads_.begin(), heads_.end(), moved) == heads_.end()) heads_.push_back(moved);
    traits_.targets.assign(targets_.begin(), targets_.end());
    traits_.heads.assign(heads_.begin(), heads_.end());
    traits_.moves.assign(moves_.begin(), moves_.end());
  }

  LossRule rule() const override { return rule_; }
  LossTraits traits() const override { return traits_; }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override {
    if (!has_targets(batch)) return 0;
    const auto counted = called(owner_ + ".counted",
                                [&] { return instance_->attr("counted")(arrays(batch), rays).cast<std::int64_t>(); });
    if (counted < 0 || counted > rays)
      throw Error(ErrorKind::failure, "plugin.python.value",
                  owner_ + ".counted: " + std::to_string(counted) + " of " + std::to_string(rays) + " rays",
                  "return how many of the batch's rays the mean is over");
    return counted;
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
  bool has_targets(const RayTargets& batch) const {
    return std::all_of(targets_.begin(), targets_.end(), [&](const std::string& name) {
      return name == channel::color   ? batch.color.cols > 0
             : name == channel::label ? batch.label.cols > 0
                                      : batch.more[name].cols > 0;
    });
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
    put(out, "unit_m", View<const double>(&values.unit_m, 1, 1));
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
  // Of RayValues or RayGradients: a channel that a loss moves.
  template <class All>
  static auto moved_in(const All& all, std::string_view name) {
    if (name == channel::color) return all.color;
    if (name == channel::depth) return all.depth;
    if (name == channel::weight) return all.weight;
    if (name == channel::sigma) return all.sigma;
    return all.heads[name];
  }

  template <class Real>
  double add_real(const RayTargets& targets, const RayValues<Real>& values, double scale,
                  const RayGradients<Real>& gradients) const {
    if (values.first.rows <= 1 || !has_targets(targets)) return 0;
    return called(owner_ + ".value", [&] {
      const py::object answer = instance_->attr("value")(arrays(targets), arrays(values));
      if (!py::isinstance<py::tuple>(answer) || py::len(answer) != 2 || !py::isinstance<py::dict>(answer[py::int_(1)]))
        throw Error(ErrorKind::failure, "plugin.python.value",
                    owner_ + ".value: expected a loss and a dict of gradients");
      const py::dict given = answer[py::int_(1)];
      std::vector<Shape> lengths{{values.first.rows - 1}};
      for (const std::string& name : heads_)
        if (const auto rows = values.heads[name]; rows.cols > 0) lengths.push_back({rows.rows});
      const py::array loss = real_array(owner_ + ".value", answer[py::int_(0)], lengths);
      for (const std::string& name : moves_) {
        if (moved_in(values, name).cols > 0 && !given.contains(name.c_str()))
          throw Error(ErrorKind::failure, "plugin.python.moves",
                      gradient_of(name) + " is missing, and `moves` names it", "give zeros where there is none");
      }
      for (const auto& [key, gradient] : given) {
        const auto name = py::str(key).cast<std::string>();
        if (!traits_.does_move(name))
          throw Error(ErrorKind::failure, "plugin.python.moves", gradient_of(name) + ", which `moves` does not name");
        add_rows(gradient_of(name), gradient, scale, moved_in(values, name), moved_in(gradients, name));
      }
      return loss.attr("sum")().template cast<double>();
    });
  }
  std::string gradient_of(const std::string& name) const { return owner_ + ".value: gradient of '" + name + "'"; }
  template <class Real>
  static void add_rows(const std::string& what, const py::handle& given, double scale, View<const Real> value,
                       View<Real> to) {
    const auto array = py::array_t<double, py::array::c_style | py::array::forcecast>(
        real_array(what, given, {{value.rows, value.cols}}));
    if (to.empty()) return;
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
