#include "python/core/plugins.h"

#include <pybind11/stl.h>

#include <algorithm>
#include <filesystem>
#include <memory>
#include <set>

#include "plugin/linked_plugins.h"
#include "plugin/loader.h"
#include "python/core/arrays.h"
#include "python/core/errors.h"
#include "python/core/plugin_calls.h"
#include "python/core/plugin_head.h"
#include "python/core/plugin_loss.h"
#include "python/core/plugin_params.h"
#include "python/core/plugin_tensors.h"
#include "python/core/scene_values.h"

namespace semfield::python {

namespace {

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
  PythonEncoder(const std::string& name, const Held& type, const PythonParams& params, const EncoderBuild& build)
      : owner_("encoder '" + name + "'") {
    called(owner_, [&] {
      py::dict facts;
      facts["in_dims"] = build.in_dims;
      facts["is_direction"] = build.is_direction;
      facts["extent_m"] = build.extent_m;
      facts["pixel_footprint_m"] = build.pixel_footprint_m;
      facts["largest_coordinate"] = build.largest_coordinate;
      const py::object made = type->attr("_made")(params.values(), facts);
      traits_.in_dims = build.in_dims;
      traits_.out_dims = made.attr("out_dims").template cast<std::int32_t>();
      traits_.domain = domain_of(made.attr("domain").template cast<std::string>(), owner_);
      tensors_ = PythonTensors<Real>(made);
      instance_ = hold(made);
    });
    if (traits_.out_dims <= 0)
      throw Error(ErrorKind::usage, "plugin.python.declaration", owner_ + ": setup must set out_dims above 0");
  }

  EncoderTraits traits() const noexcept override { return traits_; }
  void declare(ParamDeclarer& declarer) const override { tensors_.declare(declarer); }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>& tensors, View<const double> x, View<Real> y) const override {
    called(owner_ + ".forward",
           [&] { take(owner_ + ".forward", instance_->attr("forward")(borrowed(x), tensors_.values(tensors)), y); });
  }
  void do_backward(const StepContext&, const Tensors<Real>& tensors, View<const double> x, View<const Real> dy,
                   View<Real> dx) const override {
    called(owner_ + ".backward", [&] {
      const py::object answer = tensors_.with_gradients(owner_ + ".backward", tensors, [&](const py::dict& grads) {
        return instance_->attr("backward")(borrowed(x), borrowed(dy), tensors_.values(tensors), grads);
      });
      if (!dx.empty()) take(owner_ + ".backward", answer, dx);
    });
  }

 private:
  std::string owner_;
  EncoderTraits traits_;
  PythonTensors<Real> tensors_;
  Held instance_;
};

class PythonDataset final : public Dataset {
 public:
  PythonDataset(const std::string& name, const Held& type, const PythonParams& params, const DatasetBuild& build)
      : owner_("dataset '" + name + "'") {
    called(owner_, [&] { instance_ = hold(type->attr("_made")(params.values(), build.config_dir)); });
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

void load_file(Registry& registry, const std::string& path) {
  LoadOptions options;
  options.python = load_python_file;
  load_module(registry, path, options);
}

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

PluginEntry entry_of(const py::dict& declared, PluginKind kind) {
  PluginEntry entry;
  entry.slow = true;
  entry.kind = kind;
  entry.name = declared["name"].cast<std::string>();
  entry.summary = declared["summary"].cast<std::string>();
  const std::vector<PythonParam> params =
      params_of(declared["params"].cast<py::list>(), std::string(kind_name(kind)) + " '" + entry.name + "'");
  entry.new_params = [params] { return std::unique_ptr<PluginParams>(std::make_unique<PythonParams>(params)); };
  return entry;
}

void list_types(const ConfigNode& node, std::set<std::string>& types) {
  for (const ConfigNode& item : node.items()) list_types(item, types);
  for (const auto& [key, value] : node.entries()) {
    if (key == "type") types.insert(value.text());
    list_types(value, types);
  }
}

}  // namespace

Registry& base_registry() { return base().registry; }

void add_encoder(const py::dict& declared) {
  PluginEntry entry = entry_of(declared, PluginKind::encoder);
  const Held type = hold(declared["class"]);
  entry.encoder32 = [type, name = entry.name](const PluginParams& p, const EncoderBuild& build, const KernelTables&) {
    return std::unique_ptr<Encoder<float>>(
        std::make_unique<PythonEncoder<float>>(name, type, static_cast<const PythonParams&>(p), build));
  };
  entry.encoder64 = [type, name = entry.name](const PluginParams& p, const EncoderBuild& build, const KernelTables&) {
    return std::unique_ptr<Encoder<double>>(
        std::make_unique<PythonEncoder<double>>(name, type, static_cast<const PythonParams&>(p), build));
  };
  add(std::move(entry));
}

void add_dataset(const py::dict& declared) {
  PluginEntry entry = entry_of(declared, PluginKind::dataset);
  const Held type = hold(declared["class"]);
  entry.dataset = [type, name = entry.name](const PluginParams& p, const DatasetBuild& build) {
    return std::unique_ptr<Dataset>(
        std::make_unique<PythonDataset>(name, type, static_cast<const PythonParams&>(p), build));
  };
  add(std::move(entry));
}

void add_head(const py::dict& declared) {
  PluginEntry entry = entry_of(declared, PluginKind::head);
  const Held type = hold(declared["class"]);
  entry.head32 = [type, name = entry.name](const PluginParams& p, const HeadBuild& build, const KernelTables&) {
    return make_python_head<float>(name, *type, static_cast<const PythonParams&>(p), build);
  };
  entry.head64 = [type, name = entry.name](const PluginParams& p, const HeadBuild& build, const KernelTables&) {
    return make_python_head<double>(name, *type, static_cast<const PythonParams&>(p), build);
  };
  add(std::move(entry));
}

void add_loss(const py::dict& declared) {
  PluginEntry entry = entry_of(declared, PluginKind::loss);
  entry.saves = "calls of Python";
  entry.loss = [type = hold(declared["class"]), name = entry.name](const PluginParams& p) {
    return make_python_loss(name, *type, static_cast<const PythonParams&>(p));
  };
  add(std::move(entry));
}

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
  module.def("add_encoder", add_encoder);
  module.def("add_dataset", add_dataset);
  module.def("add_head", add_head);
  module.def("add_loss", add_loss);
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
