#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <filesystem>
#include <memory>
#include <set>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "plugin/head.h"
#include "plugin/loader.h"
#include "plugin/loss.h"
#include "plugin/parametric.h"
#include "python/core/errors.h"
#include "python/core/values.h"

namespace semfield::python {

namespace {

using namespace pybind11::literals;

// An object of Python that threads without the GIL may hold and drop.
using Held = std::shared_ptr<py::object>;

Held hold(py::object object) {
  return {new py::object(std::move(object)), [](py::object* p) {
            if (Py_IsInitialized() == 0) return;  // the process ends: nothing is given back any more
            const py::gil_scoped_acquire gil;
            delete p;
          }};
}

// Calls code of a plugin with the GIL, which may take `doing`; what it raises becomes an Error.
template <class Call>
auto called(const std::string& doing, const Call& call) {
  const py::gil_scoped_acquire gil;
  try {
    if constexpr (std::is_invocable_v<Call, const std::string&>) {
      return call(doing);
    } else {
      return call();
    }
  } catch (py::error_already_set& raised) {
    if (raised.matches(PyExc_KeyboardInterrupt)) {
      note_interrupt();
      throw;
    }
    throw error_of(raised, doing);
  } catch (const py::cast_error& wrong) {
    throw Error(ErrorKind::failure, "plugin.python.value", doing + ": " + wrong.what());
  }
}

// Learned numbers of components that are written in Python, and arrays that they return.

using Shape = std::vector<py::ssize_t>;

std::string shape_text(const py::ssize_t* sizes, std::size_t count) {
  std::string out;
  for (std::size_t i = 0; i < count; ++i) out += (i == 0 ? "" : ", ") + std::to_string(sizes[i]);
  return "(" + out + (count == 1 ? ",)" : ")");
}

// What `doing` ("head 'x'.output") returned, as an array of one of these shapes exactly: NumPy would stretch one row
// to all of them. Throws Error(failure) for another shape or type.
py::array real_array(const std::string& doing, const py::handle& answer, const std::vector<Shape>& shapes) {
  const py::array given = py::array::ensure(answer);
  const auto has = [&](const Shape& shape) {
    return std::equal(shape.begin(), shape.end(), given.shape(), given.shape() + given.ndim());
  };
  if (!given || std::none_of(shapes.begin(), shapes.end(), has)) {
    PyErr_Clear();
    std::string wanted;
    for (const Shape& shape : shapes) wanted += (wanted.empty() ? "" : " or ") + shape_text(shape.data(), shape.size());
    const std::string got = given ? shape_text(given.shape(), static_cast<std::size_t>(given.ndim()))
                                  : py::repr(py::type::handle_of(answer)).cast<std::string>();
    throw Error(ErrorKind::failure, "plugin.python.shape",
                doing + ": expected an array of the shape " + wanted + ", got " + got);
  }
  if (std::string_view("fiub").find(given.dtype().kind()) == std::string_view::npos)
    throw Error(ErrorKind::failure, "plugin.python.value",
                doing + ": expected real numbers, got " + py::str(given.dtype()).cast<std::string>());
  return given;
}

// Copies what `doing` returned.
template <class Real>
void take(const std::string& doing, const py::object& answer, View<Real> to) {
  const py::array given = real_array(doing, answer, {{to.rows, to.cols}});
  py::array target = borrowed(to);
  target[py::ellipsis()] = given;
}

// An opacity that is None where nothing is known of it.
template <class Real>
struct Opacity {
  View<const Real> view;
};

// An instance of a class of Python with learned numbers, and its methods: arrays over views, then the tensors by name,
// then their gradients.
template <class Real>
class PythonPart {
 public:
  PythonPart() = default;
  // `made`: has a dict `tensors` of semfield.Tensor. With the GIL.
  PythonPart(std::string owner, const py::object& made) : owner_(std::move(owner)), instance_(hold(made)) {
    for (const auto& [tensor, spec] : made.attr("tensors").template cast<py::dict>()) {
      TensorSpec declared;
      declared.name = py::str(tensor).template cast<std::string>();
      declared.rows = spec.attr("rows").template cast<std::int64_t>();
      declared.cols = spec.attr("cols").template cast<std::int32_t>();
      declared.init = {spec.attr("low").template cast<double>(), spec.attr("high").template cast<double>()};
      specs_.push_back(std::move(declared));
    }
  }

  void declare(ParamDeclarer& declarer) const {
    for (const TensorSpec& spec : specs_) declarer.tensor(spec);
  }
  template <class... Views>
  void forward(const char* method, const Tensors<Real>& tensors, View<Real> out, const Views&... views) const {
    called(owner_ + "." + method, [&](const std::string& doing) {
      take(doing, instance_->attr(method)(array(views)..., values(tensors)), out);
    });
  }
  // `taken` gets what the method returns. Throws Error(failure) where it put another array in the place of a gradient:
  // what is not added in place would be lost.
  template <class Taken, class... Views>
  void backward(const char* method, const Tensors<Real>& tensors, const Taken& taken, const Views&... views) const {
    called(owner_ + "." + method, [&](const std::string& doing) {
      py::dict grads;
      for (std::size_t i = 0; i < specs_.size() && i < tensors.grad.size(); ++i)
        grads[py::str(specs_[i].name)] = borrowed(tensors.grad[i]);
      const py::dict before = grads.attr("copy")();
      const py::object answer = instance_->attr(method)(array(views)..., values(tensors), grads);
      for (const auto& [name, given] : before) {
        if (grads.contains(name) && py::object(grads[name]).is(given)) continue;
        throw Error(ErrorKind::failure, "plugin.python.gradient",
                    doing + ": the gradient of '" + py::str(name).template cast<std::string>() + "' was replaced",
                    "add to it in place: grads[name] += ...");
      }
      if (grads.size() != before.size())
        throw Error(ErrorKind::failure, "plugin.python.gradient", doing + ": grads got a name that no tensor has",
                    "declare the tensor in setup");
      taken(doing, answer);
    });
  }

 private:
  static py::object array(const Opacity<Real>& opacity) {
    return opacity.view.empty() ? py::object(py::none()) : py::object(borrowed(opacity.view));
  }
  template <class T>
  static py::object array(View<T> view) {
    return borrowed(View<const std::remove_const_t<T>>(view));
  }
  py::dict values(const Tensors<Real>& tensors) const {
    py::dict out;
    for (std::size_t i = 0; i < specs_.size(); ++i)
      out[py::str(specs_[i].name)] = borrowed(View<const Real>(tensors.value[i]));
    return out;
  }

  std::string owner_;
  std::vector<TensorSpec> specs_;
  Held instance_;
};

// One of a list of names.
struct ChoiceValue {
  int index = 0;
  std::vector<std::string> names;
};

struct PythonParam {
  std::string name, help;
  Range range{};
  std::variant<bool, std::int64_t, double, std::string, ChoiceValue, std::vector<std::int64_t>, std::vector<double>,
               std::vector<std::string>>
      value{};
};

class PythonParams final : public PluginParams {
 public:
  explicit PythonParams(std::vector<PythonParam> params) : params_(std::move(params)) {}
  void describe(ParamVisitor& visit) override {
    for (PythonParam& p : params_) {
      const auto one = [&](auto& value) {
        using T = std::decay_t<decltype(value)>;
        if constexpr (std::is_same_v<T, ChoiceValue>) {
          const std::vector<std::string_view> names(value.names.begin(), value.names.end());
          ChosenName choice{value.index, names};
          visit({p.name, p.help, p.range}, &choice);
          value.index = choice.index;
        } else if constexpr (std::is_same_v<T, std::int64_t>) {
          visit({p.name, p.help, p.range}, &value);
        } else {
          visit_param(visit, p.name, value, p.help, p.range);
        }
      };
      std::visit(one, p.value);
    }
  }
  void validate(Diagnostics&) const override {}
  // Name to value; with the GIL.
  py::dict values() const {
    py::dict out;
    for (const PythonParam& p : params_) {
      const auto one = [](const auto& value) -> py::object {
        if constexpr (std::is_same_v<std::decay_t<decltype(value)>, ChoiceValue>) {
          return py::str(value.names[static_cast<std::size_t>(value.index)]);
        } else {
          return py::cast(value);
        }
      };
      out[py::str(p.name)] = std::visit(one, p.value);
    }
    return out;
  }

 private:
  std::vector<PythonParam> params_;
};

// From dicts {name, help, default, low, high, choices}, which semfield/plugins.py has checked.
std::vector<PythonParam> params_of(const py::list& declared) {
  std::vector<PythonParam> out;
  for (const py::handle row : declared) {
    const auto item = py::reinterpret_borrow<py::dict>(row);
    PythonParam& p = out.emplace_back(PythonParam{item["name"].cast<std::string>(), item["help"].cast<std::string>()});
    if (!item["low"].is_none()) p.range.min = item["low"].cast<double>();
    if (!item["high"].is_none()) p.range.max = item["high"].cast<double>();
    if (!item["choices"].is_none()) {
      ChoiceValue choice{0, item["choices"].cast<std::vector<std::string>>()};
      const auto at = std::find(choice.names.begin(), choice.names.end(), item["default"].cast<std::string>());
      choice.index = static_cast<int>(at - choice.names.begin());
      p.value = std::move(choice);
      continue;
    }
    // The first that it is without a conversion: a list without numbers is one of real ones.
    py::detail::make_caster<std::variant<bool, std::int64_t, double, std::string, std::vector<double>,
                                         std::vector<std::int64_t>, std::vector<std::string>>>
        plain;
    if (!plain.load(item["default"], false)) throw py::cast_error("the default of '" + p.name + "' is too large");
    std::visit([&p](auto& value) { p.value = std::move(value); }, *plain);
  }
  return out;
}

template <class Real>
class PythonHead final : public Head<Real> {
 public:
  PythonHead(const std::string& name, const Held& type, const PythonParams& params, const HeadBuild& build,
             const KernelTables&)
      : owner_("head '" + name + "'"), width_(build.width) {
    if (build.device != Device::cpu)
      throw Error(ErrorKind::unavailable, "plugin.kernels.missing",
                  owner_ + " is written in Python and has no " + std::string(device_name(build.device)) + " kernels");
    called(owner_, [&] {
      const py::object made =
          type->attr("_made")(params.values(), "feature_dims"_a = build.feature_dims, "width"_a = build.width);
      hidden_ = made.attr("hidden_width").template cast<std::int32_t>();
      part_ = PythonPart<Real>(owner_, made);
    });
    if (hidden_ <= 0)
      throw Error(ErrorKind::usage, "plugin.python.declaration", owner_ + ": setup must set hidden_width above 0");
  }

  std::int32_t hidden_width() const override { return hidden_; }
  std::int32_t width() const override { return width_; }
  void declare(ParamDeclarer& declarer) const override { part_.declare(declarer); }

  void hidden_forward(const StepContext&, const Tensors<Real>& tensors, View<const Real> feature,
                      View<Real> hidden) const override {
    part_.forward("hidden", tensors, hidden, feature);
  }
  void hidden_backward(const StepContext&, const Tensors<Real>& tensors, View<const Real> feature,
                       View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const override {
    const auto taken = [&](const std::string& doing, const py::object& answer) { take(doing, answer, d_feature); };
    part_.backward("hidden_backward", tensors, taken, feature, hidden, d_hidden);
  }
  void output_forward(const StepContext&, const Tensors<Real>& tensors, View<const Real> h, View<const Real> opacity,
                      View<Real> rows) const override {
    part_.forward("output", tensors, rows, h, Opacity<Real>{opacity});
  }
  void output_backward(const StepContext&, const Tensors<Real>& tensors, View<const Real> h, View<const Real> opacity,
                       View<const Real> d_rows, View<Real> d_h, View<Real> d_opacity) const override {
    const auto taken = [&](const std::string& doing, const py::object& answer) {
      if (!py::isinstance<py::tuple>(answer) || py::len(answer) != 2)
        throw Error(ErrorKind::failure, "plugin.python.shape",
                    doing + ": expected two arrays, dL/dh and dL/d(opacity)");
      take(doing + ", dL/dh", py::object(answer[py::int_(0)]), d_h);
      if (!d_opacity.empty()) take(doing + ", dL/d(opacity)", py::object(answer[py::int_(1)]), d_opacity);
    };
    part_.backward("output_backward", tensors, taken, h, Opacity<Real>{opacity}, d_rows);
  }

 private:
  std::string owner_;
  std::int32_t hidden_ = 0, width_ = 0;
  PythonPart<Real> part_;
};

class PythonLoss final : public Loss {
 public:
  PythonLoss(const std::string& name, const Held& type, const PythonParams& params) : owner_("loss '" + name + "'") {
    called(owner_, [&] {
      const py::object made = type->attr("_made")(params.values());
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

Domain domain_of(const std::string& name, const std::string& owner) {
  if (name == "metric") return Domain::metric;
  if (name == "unit_cube") return Domain::unit_cube;
  if (name == "direction") return Domain::direction;
  throw Error(ErrorKind::usage, "plugin.python.declaration", owner + ": there is no domain '" + name + "'",
              "it is metric, unit_cube or direction");
}

template <class Real>
class PythonEncoder final : public Encoder<Real> {
 public:
  PythonEncoder(const std::string& name, const Held& type, const PythonParams& params, const EncoderBuild& build,
                const KernelTables&)
      : owner_("encoder '" + name + "'") {
    called(owner_, [&] {
      const py::dict facts("in_dims"_a = build.in_dims, "is_direction"_a = build.is_direction,
                           "extent_m"_a = build.extent_m, "pixel_footprint_m"_a = build.pixel_footprint_m,
                           "largest_coordinate"_a = build.largest_coordinate);
      const py::object made = type->attr("_made")(params.values(), "in_dims"_a = build.in_dims, "build"_a = facts);
      traits_.in_dims = build.in_dims;
      traits_.out_dims = made.attr("out_dims").template cast<std::int32_t>();
      traits_.domain = domain_of(made.attr("domain").template cast<std::string>(), owner_);
      part_ = PythonPart<Real>(owner_, made);
    });
    if (traits_.out_dims <= 0)
      throw Error(ErrorKind::usage, "plugin.python.declaration", owner_ + ": setup must set out_dims above 0");
  }

  EncoderTraits traits() const noexcept override { return traits_; }
  void declare(ParamDeclarer& declarer) const override { part_.declare(declarer); }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>& tensors, View<const double> x, View<Real> y) const override {
    part_.forward("forward", tensors, y, x);
  }
  void do_backward(const StepContext&, const Tensors<Real>& tensors, View<const double> x, View<const Real> dy,
                   View<Real> dx) const override {
    const auto taken = [&](const std::string& doing, const py::object& answer) {
      if (!dx.empty()) take(doing, answer, dx);
    };
    part_.backward("backward", tensors, taken, x, dy);
  }

 private:
  std::string owner_;
  EncoderTraits traits_;
  PythonPart<Real> part_;
};

class PythonDataset final : public Dataset {
 public:
  PythonDataset(const std::string& name, const Held& type, const PythonParams& params, const DatasetBuild& build)
      : owner_("dataset '" + name + "'") {
    called(owner_, [&] { instance_ = hold(type->attr("_made")(params.values(), "config_dir"_a = build.config_dir)); });
  }
  SceneInfo open(Diagnostics& diagnostics) override {
    info_ = called(owner_ + ".open", [&] { return scene_info_of(instance_->attr("_opened")(), diagnostics); });
    return info_;
  }
  void read(int frame, FrameBuffer& out) const override {
    called(owner_ + ".read", [&] {
      const py::object pixels = instance_->attr("_read")(frame);
      fill_frame(pixels.cast<py::dict>(), info_, frame, out);
    });
  }

 private:
  std::string owner_;
  Held instance_;
  SceneInfo info_;
};

// Everything of this process that sessions start from.
struct Base {
  Registry registry;
  std::vector<PluginEntry> defined;  // in this process, not in a file
  std::vector<std::string> files;    // loaded, in order
  Registry* loading = nullptr;       // where a file that runs now adds its plugins; guarded by the GIL
};

Base& base() {
  static Base& made = [&]() -> Base& {
    auto* const fresh = new Base;  // never destroyed: it holds objects of Python
    register_linked_plugins(fresh->registry);
    return *fresh;
  }();
  return made;
}

// Runs a file of Python, whose plugins go into `registry`. Throws Error(unavailable) for a file that raises, or that
// defines no plugin. To be called with the GIL.
void load_python_file(Registry& registry, const std::string& path) {
  const std::string doing = "cannot load plugin '" + path + "'";
  Registry trial = registry;
  trial.set_current_module(std::filesystem::path(path).filename().string());
  const std::size_t before = trial.entries().size();
  Base& b = base();
  Registry* const outer = b.loading;
  b.loading = &trial;
  try {
    py::module_::import("semfield.plugins").attr("_run_file")(path);
  } catch (py::error_already_set& raised) {
    b.loading = outer;
    const Error error = error_of(raised, doing);
    throw Error(ErrorKind::unavailable, error.code(), error.message(), "fix the file, or leave it out");
  }
  b.loading = outer;
  if (trial.entries().size() == before)
    throw Error(ErrorKind::unavailable, "plugin.module.empty", doing + ": it defines no plugin",
                "decorate a class with @semfield.encoder(\"name\"), .dataset, .head or .loss");
  trial.set_current_module({});
  trial.add_module_file(path);
  registry = std::move(trial);
}

void load_file(Registry& registry, const std::string& path) { load_module(registry, path, load_python_file); }

void rebuild() {
  Base& b = base();
  Registry fresh;
  register_linked_plugins(fresh);
  for (const std::string& file : b.files) load_file(fresh, file);
  fresh.set_current_module("Python");
  for (const PluginEntry& entry : b.defined) fresh.add(entry);
  fresh.set_current_module({});
  b.registry = std::move(fresh);
}

void add(PluginEntry entry) {
  Base& b = base();
  if (b.loading != nullptr) {
    b.loading->add(std::move(entry));
    return;
  }
  // Defined again, as cells of a notebook are: the last one counts.
  const auto same = [&](const PluginEntry& e) { return e.kind == entry.kind && e.name == entry.name; };
  const std::vector<PluginEntry> before = b.defined;
  std::erase_if(b.defined, same);
  b.defined.push_back(std::move(entry));
  try {
    rebuild();
  } catch (...) {
    b.defined = before;
    throw;
  }
}

void list_types(const ConfigNode& node, std::set<std::string>& types) {
  for (const ConfigNode& item : node.items()) list_types(item, types);
  for (const auto& [key, value] : node.entries()) {
    if (key == "type") types.insert(value.text());
    list_types(value, types);
  }
}

// What makes a `Made` of the class that was decorated.
template <class Interface, class Made>
auto factory(const Held& type, const std::string& name) {
  return [type, name](const PluginParams& params, const auto&... build) {
    const auto& own = static_cast<const PythonParams&>(params);
    return std::unique_ptr<Interface>(std::make_unique<Made>(name, type, own, build...));
  };
}

// Where the decorators of semfield/plugins.py add their plugins.
void add_plugin(const py::dict& declared) {
  PluginEntry entry;
  entry.slow = true;
  entry.name = declared["name"].cast<std::string>();
  entry.summary = declared["summary"].cast<std::string>();
  const auto kind = declared["kind"].cast<std::string>();
  const std::vector<PythonParam> params = params_of(declared["params"].cast<py::list>());
  entry.new_params = [params] { return std::unique_ptr<PluginParams>(std::make_unique<PythonParams>(params)); };
  const Held type = hold(declared["class"]);
  if (kind == "encoder") {
    entry.kind = PluginKind::encoder;
    entry.encoder32 = factory<Encoder<float>, PythonEncoder<float>>(type, entry.name);
    entry.encoder64 = factory<Encoder<double>, PythonEncoder<double>>(type, entry.name);
  } else if (kind == "head") {
    entry.kind = PluginKind::head;
    entry.head32 = factory<Head<float>, PythonHead<float>>(type, entry.name);
    entry.head64 = factory<Head<double>, PythonHead<double>>(type, entry.name);
  } else if (kind == "loss") {
    entry.kind = PluginKind::loss;
    entry.saves = "calls of Python";
    entry.loss = factory<Loss, PythonLoss>(type, entry.name);
  } else {
    entry.kind = PluginKind::dataset;
    entry.dataset = factory<Dataset, PythonDataset>(type, entry.name);
  }
  add(std::move(entry));
}

}  // namespace

Registry& base_registry() { return base().registry; }

RunConfig session_config_of(const ConfigNode& tree, Registry& registry) {
  RunConfig config = run_config_of(tree, registry);
  std::set<std::string> types;
  list_types(resolved_config(config), types);
  std::erase_if(config.plugins, [&](const std::string& file) {
    if (!file.ends_with(".py")) return false;
    const std::string module = std::filesystem::path(file).filename().string();
    const std::vector<const PluginEntry*> entries = registry.entries();
    return std::none_of(entries.begin(), entries.end(),
                        [&](const PluginEntry* e) { return e->module == module && types.contains(e->name); });
  });
  return config;
}

void define_plugins(py::module_& module) {
  module.def("add_plugin", add_plugin);
  module.def("load_plugin", [](const std::string& path) {
    Base& b = base();
    const std::string file = std::filesystem::absolute(path).lexically_normal().string();
    if (std::find(b.files.begin(), b.files.end(), file) != b.files.end()) return;
    Registry trial = b.registry;
    load_file(trial, file);
    b.registry = std::move(trial);
    b.files.push_back(file);
  });
  module.def("plugin_names", [] {
    py::list out;
    for (const PluginEntry* entry : base().registry.entries())
      out.append(py::make_tuple(std::string(kind_name(entry->kind)), entry->name, entry->summary, entry->module));
    return out;
  });
  // For libsemfield_python.so, by which the program loads a file of Python: a function of C++, whose errors pass as
  // they are, and the framework that it belongs to.
  static const struct {
    void (*load)(Registry&, const std::string&);
    const char* (*framework)();
  } host{load_python_file, abi_tag_of_framework};
  module.attr("_host") = py::capsule(&host, "semfield.host");
}

}  // namespace semfield::python
