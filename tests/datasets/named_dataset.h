// Linked datasets by their names, with parameters as texts.
#pragma once

#include "config/config_tree.h"
#include "testkit/laws.h"
#include "tests/linked_registry.h"
#include "tests/says.h"

namespace semfield {

class NamedDataset final : public Dataset {
 public:
  NamedDataset(const std::string& name, const testkit::Settings& settings, const DatasetBuild& build = {}) {
    const PluginEntry& entry = testkit::linked_registry().get(PluginKind::dataset, name);
    dataset_ = entry.dataset(*testkit::make_params(entry, settings), build);
  }
  SceneInfo open(Diagnostics& diagnostics) override { return dataset_->open(diagnostics); }
  /// Without an error.
  SceneInfo open() {
    Diagnostics diagnostics;
    const SceneInfo info = dataset_->open(diagnostics);
    EXPECT_FALSE(diagnostics.has_errors()) << all_said(diagnostics);
    return info;
  }
  void read(int frame, FrameBuffer& out) const override { dataset_->read(frame, out); }
  FrameBuffer read(int frame) const {
    FrameBuffer out;
    dataset_->read(frame, out);
    return out;
  }

 private:
  std::unique_ptr<Dataset> dataset_;
};

/// What a dataset recognises at a path ("" for nothing), and the `root` that it takes then.
struct Recognised {
  Recognised(const std::string& name, const std::string& path) {
    const auto params = testkit::linked_registry().get(PluginKind::dataset, name).new_params();
    what = params->recognise(path);
    root = params_to_config([&](ParamVisitor& visit) { params->describe(visit); }).find("root")->text();
  }
  std::string what, root;
};

}  // namespace semfield
