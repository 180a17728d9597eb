// The one registry: what plugins exist, how to describe them and how to make them.
#pragma once

#include <array>
#include <concepts>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/grouping.h"
#include "plugin/head.h"
#include "plugin/kernels.h"
#include "plugin/loss.h"
#include "plugin/sampler.h"
#include "scene/dataset.h"

namespace semfield {

class LabelReader;
class Degradation;
template <class Real>
class MlpField;

enum class PluginKind : std::uint8_t {
  encoder,
  field,
  sampler,
  dataset,
  head,
  loss,
  label_reader,
  degradation,
  grouping
};
/// In the order of documents.
inline constexpr std::array kPluginKinds{PluginKind::encoder,      PluginKind::field,       PluginKind::sampler,
                                         PluginKind::dataset,      PluginKind::head,        PluginKind::loss,
                                         PluginKind::label_reader, PluginKind::degradation, PluginKind::grouping};
std::string_view kind_name(PluginKind kind);
/// "encoders", as the folder of its plugins is named.
std::string_view kind_folder(PluginKind kind);

/// A plugin's parameter struct with its type erased.
class PluginParams {
 public:
  virtual ~PluginParams() = default;
  virtual void describe(ParamVisitor& visit) = 0;
  /// Only relations between parameters; ranges are checked while reading.
  virtual void validate(Diagnostics& diagnostics) const = 0;
  /// Replaces values that stand for "chosen from the scene" by numbers and adds a sentence for each; called once,
  /// before anything is built, so that the resolved configuration holds what was chosen.
  virtual void choose(const EncoderBuild&, std::vector<std::string>&) {}
  /// The same for values that the device decides.
  virtual void choose_for(Device, std::vector<std::string>&) {}
  /// Of a dataset: what `path`, a folder or a file, holds that it reads, in a few words ("a transforms.json"), and its
  /// parameters become those that read it there. "" where it holds nothing of the kind. Looks at names and first bytes
  /// alone, and throws nothing.
  virtual std::string recognise(const std::string&) { return {}; }
  /// Of a dataset: how what lies in a folder that no dataset recognises becomes a scene that this one reads, in lines
  /// for the user: commands of another program. "" where nothing is to be made of it. Throws nothing.
  virtual std::string preparation(const std::string&) const { return {}; }
};

namespace plugin_detail {
// Unqualified calls from here see only argument-dependent candidates: the plugin's own functions.
inline constexpr auto call_describe = [](ParamVisitor& visit, auto& params) {
  if constexpr (requires { params.describe(visit); }) {
    params.describe(visit);
  } else {
    describe(visit, params);
  }
};
inline constexpr auto call_validate = [](const auto& params, Diagnostics& diagnostics) {
  if constexpr (requires { params.validate(diagnostics); }) {
    params.validate(diagnostics);
  } else if constexpr (requires { validate(params, diagnostics); }) {
    validate(params, diagnostics);
  }
};
inline constexpr auto call_choose = [](auto& params, const EncoderBuild& build, std::vector<std::string>& chosen) {
  if constexpr (requires { choose(params, build, chosen); }) choose(params, build, chosen);
};
inline constexpr auto call_choose_for = [](auto& params, Device device, std::vector<std::string>& chosen) {
  if constexpr (requires { choose_for(params, device, chosen); }) choose_for(params, device, chosen);
};
inline constexpr auto call_recognise = [](const std::string& path, auto& params) -> std::string {
  if constexpr (requires { recognise(path, params); }) return recognise(path, params);
  return {};
};
inline constexpr auto call_preparation = [](const std::string& folder, const auto& params) -> std::string {
  if constexpr (requires { preparation(folder, params); }) return preparation(folder, params);
  return {};
};
}  // namespace plugin_detail

/// Params needs `void describe(ParamVisitor&, Params&)` in its namespace, and may have `void validate(const Params&,
/// Diagnostics&)` and `void choose_for(Params&, Device, std::vector<std::string>&)`; an encoder's may have `void
/// choose(Params&, const EncoderBuild&, std::vector<std::string>&)`, a dataset's `std::string recognise(const
/// std::string& path, Params&)` and `std::string preparation(const std::string& folder, const Params&)`. Or it is a
/// plugin whose objects hold their parameters and declare them by members describe() and validate().
template <class Params>
class ParamsOf final : public PluginParams {
 public:
  void describe(ParamVisitor& visit) override {
    if constexpr (std::derived_from<Params, LossRule>) describe_rule(visit, value);
    plugin_detail::call_describe(visit, value);
  }
  void validate(Diagnostics& diagnostics) const override { plugin_detail::call_validate(value, diagnostics); }
  void choose(const EncoderBuild& build, std::vector<std::string>& chosen) override {
    plugin_detail::call_choose(value, build, chosen);
  }
  void choose_for(Device device, std::vector<std::string>& chosen) override {
    plugin_detail::call_choose_for(value, device, chosen);
  }
  std::string recognise(const std::string& path) override { return plugin_detail::call_recognise(path, value); }
  std::string preparation(const std::string& folder) const override {
    return plugin_detail::call_preparation(folder, value);
  }
  Params value;
};

template <class Made, class Build>
using MakerOf = std::unique_ptr<Made>(const PluginParams&, const Build&, const KernelTables&);

struct PluginEntry {
  PluginKind kind = PluginKind::encoder;
  std::string name;
  std::string summary;  ///< one sentence
  std::string module;   ///< module that registered it, with version: "waves 1.0"
  std::function<std::unique_ptr<PluginParams>()> new_params;
  // Exactly the maker of the entry's kind is set. Real = float is what runs, double is the oracle.
  template <class Made, class Build>
  using Maker = std::function<MakerOf<Made, Build>>;
  Maker<Encoder<float>, EncoderBuild> encoder32;
  Maker<Encoder<double>, EncoderBuild> encoder64;
  Maker<Field<float>, FieldBuild> field32;
  Maker<Field<double>, FieldBuild> field64;
  Maker<Sampler<float>, SamplerBuild> sampler32;
  Maker<Sampler<double>, SamplerBuild> sampler64;
  Maker<Head<float>, HeadBuild> head32;
  Maker<Head<double>, HeadBuild> head64;
  std::function<std::unique_ptr<Dataset>(const PluginParams&, const DatasetBuild&)> dataset;
  std::function<std::unique_ptr<Loss>(const PluginParams&)> loss;
  std::function<std::unique_ptr<LabelReader>(const PluginParams&)> label_reader;
  std::function<std::unique_ptr<Degradation>(const PluginParams&)> degradation;
  std::function<std::unique_ptr<Grouping>(const PluginParams&)> grouping;
  std::string saves;   ///< of a loss: what its absence saves, in words
  bool usual = false;  ///< a grouping that is taken where none is named
  bool slow = false;   ///< calls take so long that the laws are checked on fewer rows (plugins in Python)
};

class Registry {
 public:
  Registry();  ///< has no plugin, and the kernels of networks

  /// Throws Error(unavailable) for a name taken in its kind, naming both modules.
  void add(PluginEntry entry);

  /// add_encoder<Waves, WavesParams>("waves", "sentence"): Waves<Real>(const WavesParams&, const EncoderBuild&, const
  /// KernelTables&).
  template <template <class> class Impl, class Params>
  void add_encoder(std::string name, std::string summary) {
    PluginEntry e = entry_of<Params>(PluginKind::encoder, std::move(name), std::move(summary));
    add_real<Impl, Params>(std::move(e), &PluginEntry::encoder32, &PluginEntry::encoder64);
  }
  /// The same for fields. A field of plugin/mlp/field.h whose function bf16 would spoil says
  /// `static constexpr bool kInBf16 = false`.
  template <template <class> class Impl, class Params>
  void add_field(std::string name, std::string summary) {
    PluginEntry e = entry_of<Params>(PluginKind::field, std::move(name), std::move(summary));
    if constexpr (std::is_base_of_v<MlpField<float>, Impl<float>>) {
      bool in_bf16 = true;
      if constexpr (requires { Impl<float>::kInBf16; }) in_bf16 = Impl<float>::kInBf16;
      kernels_.compose("field '" + e.name + "'", kMlpOwner, in_bf16);
    }
    add_real<Impl, Params>(std::move(e), &PluginEntry::field32, &PluginEntry::field64);
  }
  template <template <class> class Impl, class Params>
  void add_sampler(std::string name, std::string summary) {
    PluginEntry e = entry_of<Params>(PluginKind::sampler, std::move(name), std::move(summary));
    add_real<Impl, Params>(std::move(e), &PluginEntry::sampler32, &PluginEntry::sampler64);
  }
  /// The same for heads. One that is a OneLayerHead has kernels where that has some.
  template <template <class> class Impl, class Params>
  void add_head(std::string name, std::string summary) {
    PluginEntry e = entry_of<Params>(PluginKind::head, std::move(name), std::move(summary));
    if constexpr (std::is_base_of_v<OneLayerHead<float>, Impl<float>>)
      kernels_.compose("head '" + e.name + "'", kHeadOwner, false);
    add_real<Impl, Params>(std::move(e), &PluginEntry::head32, &PluginEntry::head64);
  }
  /// Impl(const Params&, const DatasetBuild&).
  template <class Impl, class Params>
  void add_dataset(std::string name, std::string summary) {
    PluginEntry e = entry_of<Params>(PluginKind::dataset, std::move(name), std::move(summary));
    e.dataset = [](const PluginParams& p, const DatasetBuild& build) -> std::unique_ptr<Dataset> {
      return std::make_unique<Impl>(static_cast<const ParamsOf<Params>&>(p).value, build);
    };
    add(std::move(e));
  }

  /// Impl is derived from LossOf<Impl, Params>, Params from LossRule. `saves`: what its absence saves.
  template <class Impl>
  void add_loss(std::string name, std::string summary, std::string saves) {
    using Params = typename Impl::Params;
    PluginEntry e = entry_of<Params>(PluginKind::loss, std::move(name), std::move(summary));
    e.saves = std::move(saves);
    e.loss = [](const PluginParams& p) -> std::unique_ptr<Loss> {
      return std::make_unique<Impl>(static_cast<const ParamsOf<Params>&>(p).value);
    };
    add(std::move(e));
  }

  /// Impl is derived from LabelReader (labels/label_files.h).
  template <class Impl>
  void add_label_reader(std::string name, std::string summary) {
    PluginEntry e = entry_of<Impl>(PluginKind::label_reader, std::move(name), std::move(summary));
    e.label_reader = copy<LabelReader, Impl>;
    add(std::move(e));
  }
  /// Impl is derived from Degradation (labels/label_files.h).
  template <class Impl>
  void add_degradation(std::string name, std::string summary) {
    PluginEntry e = entry_of<Impl>(PluginKind::degradation, std::move(name), std::move(summary));
    e.degradation = copy<Degradation, Impl>;
    add(std::move(e));
  }

  /// Impl is derived from GroupingOf<Impl> (plugin/grouping.h). `usual`: taken where none is named.
  template <class Impl>
  void add_grouping(std::string name, std::string summary, bool usual = false) {
    PluginEntry e = entry_of<Impl>(PluginKind::grouping, std::move(name), std::move(summary));
    e.usual = usual;
    e.grouping = copy<Grouping, Impl>;
    add(std::move(e));
  }

  /// Kernel tables of every plugin.
  KernelTables& kernels() { return kernels_; }
  const KernelTables& kernels() const { return kernels_; }

  const PluginEntry* find(PluginKind kind, std::string_view name) const;
  /// Throws Error(config): "no encoder named 'wave'; known: ...; did you mean 'waves'?".
  const PluginEntry& get(PluginKind kind, std::string_view name) const;
  /// The grouping that is taken where none is named. Throws Error(unavailable) where none says so.
  const PluginEntry& usual_grouping() const;
  /// Every entry, by kind then name.
  std::vector<const PluginEntry*> entries() const;
  std::vector<std::string> names(PluginKind kind) const;

  /// Files of the modules loaded into it, in order.
  const std::vector<std::string>& module_files() const { return module_files_; }
  void add_module_file(std::string path) { module_files_.push_back(std::move(path)); }

  /// Module whose register function runs now; add() stamps entries with it.
  void set_current_module(std::string module) { current_module_ = std::move(module); }

 private:
  template <class Params>
  static PluginEntry entry_of(PluginKind kind, std::string name, std::string summary) {
    PluginEntry e;
    e.kind = kind;
    e.name = std::move(name);
    e.summary = std::move(summary);
    e.new_params = [] { return std::unique_ptr<PluginParams>(std::make_unique<ParamsOf<Params>>()); };
    return e;
  }
  template <class Base, class Impl>
  static std::unique_ptr<Base> copy(const PluginParams& p) {
    return std::make_unique<Impl>(static_cast<const ParamsOf<Impl>&>(p).value);
  }
  template <class Base, class Impl, class Params, class Build>
  static std::unique_ptr<Base> make(const PluginParams& p, const Build& build, const KernelTables& kernels) {
    return std::make_unique<Impl>(static_cast<const ParamsOf<Params>&>(p).value, build, kernels);
  }
  template <template <class> class Impl, class Params, class Single, class Twin, class Build>
  void add_real(PluginEntry e, std::function<MakerOf<Single, Build>> PluginEntry::*in_float,
                std::function<MakerOf<Twin, Build>> PluginEntry::*in_double) {
    e.*in_float = make<Single, Impl<float>, Params, Build>;
    e.*in_double = make<Twin, Impl<double>, Params, Build>;
    add(std::move(e));
  }
  std::map<std::pair<PluginKind, std::string>, PluginEntry> entries_;
  KernelTables kernels_;
  std::vector<std::string> module_files_;
  std::string current_module_;
};

}  // namespace semfield
