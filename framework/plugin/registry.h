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
#include "plugin/dataset.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/grouping.h"
#include "plugin/head.h"
#include "plugin/kernels.h"
#include "plugin/loss.h"
#include "plugin/sampler.h"

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
// Unqualified calls from here see only argument-dependent candidates: the plugin's own describe() and validate().
template <class Params>
void call_describe(ParamVisitor& visit, Params& params) {
  describe(visit, params);
}
template <class Params>
void call_validate(const Params& params, Diagnostics& diagnostics) {
  if constexpr (requires { validate(params, diagnostics); }) validate(params, diagnostics);
}
template <class Params>
void call_choose(Params& params, const EncoderBuild& build, std::vector<std::string>& chosen) {
  if constexpr (requires { choose(params, build, chosen); }) choose(params, build, chosen);
}
template <class Params>
void call_choose_for(Params& params, Device device, std::vector<std::string>& chosen) {
  if constexpr (requires { choose_for(params, device, chosen); }) choose_for(params, device, chosen);
}
template <class Params>
std::string call_recognise(const std::string& path, Params& params) {
  if constexpr (requires { recognise(path, params); }) return recognise(path, params);
  return {};
}
template <class Params>
std::string call_preparation(const std::string& folder, const Params& params) {
  if constexpr (requires { preparation(folder, params); }) return preparation(folder, params);
  return {};
}
}  // namespace plugin_detail

/// Params needs `void describe(ParamVisitor&, Params&)` in its namespace, and may have `void validate(const Params&,
/// Diagnostics&)` and `void choose_for(Params&, Device, std::vector<std::string>&)`; an encoder's may have `void
/// choose(Params&, const EncoderBuild&, std::vector<std::string>&)`, a dataset's `std::string recognise(const
/// std::string& path, Params&)` and `std::string preparation(const std::string& folder, const Params&)`.
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

/// Of a plugin whose objects hold their parameters and declare them by members describe() and validate().
template <class Item>
class ParamsInside final : public PluginParams {
 public:
  void describe(ParamVisitor& visit) override { value.describe(visit); }
  void validate(Diagnostics& diagnostics) const override { value.validate(diagnostics); }
  Item value;
};

struct PluginEntry {
  PluginKind kind = PluginKind::encoder;
  std::string name;
  std::string summary;  ///< one sentence
  std::string module;   ///< module that registered it, with version: "waves 1.0"
  std::function<std::unique_ptr<PluginParams>()> new_params;
  // Exactly the maker of the entry's kind is set. Real = float is what runs, double is the oracle.
  template <class Made, class Build>
  using Maker = std::function<std::unique_ptr<Made>(const PluginParams&, const Build&, const KernelTables&)>;
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
  std::string saves;         ///< of a loss: what its absence saves, in words
  bool reads_packs = false;  ///< a dataset that opens what loading/packed_scene.h writes, by its parameter `file`
  bool usual = false;        ///< a grouping that is taken where none is named
  bool slow = false;         ///< calls take so long that the laws are checked on fewer rows (plugins in Python)
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
    PluginEntry e = entry_of<ParamsOf<Params>>(PluginKind::encoder, std::move(name), std::move(summary));
    e.encoder32 = make<Encoder<float>, Impl<float>, Params, EncoderBuild>;
    e.encoder64 = make<Encoder<double>, Impl<double>, Params, EncoderBuild>;
    add(std::move(e));
  }
  /// The same for fields. A field of plugin/mlp/field.h whose function bf16 would spoil says
  /// `static constexpr bool kInBf16 = false`.
  template <template <class> class Impl, class Params>
  void add_field(std::string name, std::string summary) {
    PluginEntry e = entry_of<ParamsOf<Params>>(PluginKind::field, std::move(name), std::move(summary));
    e.field32 = make<Field<float>, Impl<float>, Params, FieldBuild>;
    e.field64 = make<Field<double>, Impl<double>, Params, FieldBuild>;
    if constexpr (std::is_base_of_v<MlpField<float>, Impl<float>>) {
      bool in_bf16 = true;
      if constexpr (requires { Impl<float>::kInBf16; }) in_bf16 = Impl<float>::kInBf16;
      kernels_.compose("field '" + e.name + "'", kMlpOwner, in_bf16);
    }
    add(std::move(e));
  }
  template <template <class> class Impl, class Params>
  void add_sampler(std::string name, std::string summary) {
    PluginEntry e = entry_of<ParamsOf<Params>>(PluginKind::sampler, std::move(name), std::move(summary));
    e.sampler32 = make<Sampler<float>, Impl<float>, Params, SamplerBuild>;
    e.sampler64 = make<Sampler<double>, Impl<double>, Params, SamplerBuild>;
    add(std::move(e));
  }
  /// The same for heads. One that is a OneLayerHead has kernels where that has some.
  template <template <class> class Impl, class Params>
  void add_head(std::string name, std::string summary) {
    PluginEntry e = entry_of<ParamsOf<Params>>(PluginKind::head, std::move(name), std::move(summary));
    e.head32 = make<Head<float>, Impl<float>, Params, HeadBuild>;
    e.head64 = make<Head<double>, Impl<double>, Params, HeadBuild>;
    if constexpr (std::is_base_of_v<OneLayerHead<float>, Impl<float>>)
      kernels_.compose("head '" + e.name + "'", kHeadOwner, false);
    add(std::move(e));
  }
  /// Impl(const Params&, const DatasetBuild&).
  template <class Impl, class Params>
  void add_dataset(std::string name, std::string summary, bool reads_packs = false) {
    PluginEntry e = entry_of<ParamsOf<Params>>(PluginKind::dataset, std::move(name), std::move(summary));
    e.reads_packs = reads_packs;
    e.dataset = [](const PluginParams& p, const DatasetBuild& build) -> std::unique_ptr<Dataset> {
      return std::make_unique<Impl>(static_cast<const ParamsOf<Params>&>(p).value, build);
    };
    add(std::move(e));
  }

  /// Impl is derived from LossOf<Impl, Params>, Params from LossRule. `saves`: what its absence saves.
  template <class Impl>
  void add_loss(std::string name, std::string summary, std::string saves) {
    using Params = typename Impl::Params;
    PluginEntry e = entry_of<ParamsOf<Params>>(PluginKind::loss, std::move(name), std::move(summary));
    e.saves = std::move(saves);
    e.loss = [](const PluginParams& p) -> std::unique_ptr<Loss> {
      return std::make_unique<Impl>(static_cast<const ParamsOf<Params>&>(p).value);
    };
    add(std::move(e));
  }

  /// Impl is derived from LabelReader (labels/label_files.h).
  template <class Impl>
  void add_label_reader(std::string name, std::string summary) {
    PluginEntry e = entry_of<ParamsInside<Impl>>(PluginKind::label_reader, std::move(name), std::move(summary));
    e.label_reader = copy<LabelReader, Impl>;
    add(std::move(e));
  }
  /// Impl is derived from Degradation (labels/label_files.h).
  template <class Impl>
  void add_degradation(std::string name, std::string summary) {
    PluginEntry e = entry_of<ParamsInside<Impl>>(PluginKind::degradation, std::move(name), std::move(summary));
    e.degradation = copy<Degradation, Impl>;
    add(std::move(e));
  }

  /// Impl is derived from GroupingOf<Impl> (plugin/grouping.h). `usual`: taken where none is named.
  template <class Impl>
  void add_grouping(std::string name, std::string summary, bool usual = false) {
    PluginEntry e = entry_of<ParamsInside<Impl>>(PluginKind::grouping, std::move(name), std::move(summary));
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
  /// Name of the dataset that reads packed scenes. Throws Error(unavailable) where none does.
  const std::string& pack_reader() const;
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
  /// Holder: of the parameters.
  template <class Holder>
  static PluginEntry entry_of(PluginKind kind, std::string name, std::string summary) {
    PluginEntry e;
    e.kind = kind;
    e.name = std::move(name);
    e.summary = std::move(summary);
    e.new_params = [] { return std::unique_ptr<PluginParams>(std::make_unique<Holder>()); };
    return e;
  }
  template <class Base, class Impl>
  static std::unique_ptr<Base> copy(const PluginParams& p) {
    return std::make_unique<Impl>(static_cast<const ParamsInside<Impl>&>(p).value);
  }
  template <class Base, class Impl, class Params, class Build>
  static std::unique_ptr<Base> make(const PluginParams& p, const Build& build, const KernelTables& kernels) {
    return std::make_unique<Impl>(static_cast<const ParamsOf<Params>&>(p).value, build, kernels);
  }
  std::map<std::pair<PluginKind, std::string>, PluginEntry> entries_;
  KernelTables kernels_;
  std::vector<std::string> module_files_;
  std::string current_module_;
};

}  // namespace semfield
