// A tiny scene on disk for each dataset, so that its laws run on files and not on hope.
#pragma once

#include "testkit/laws.h"

namespace semfield::testkit {

struct DatasetSample {
  Settings settings;  ///< parameters that make the dataset read the scene
  DatasetExpectation expected;
  std::string absent{};  ///< what this build lacks to read the scene; empty: nothing
};

/// Writes a tiny scene in the dataset's format into an existing empty folder.
using WriteSample = std::function<DatasetSample(const std::string& folder)>;

/// Begins the definition of one, which `<name>_sample.cpp` holds.
#define SEMFIELD_DATASET_SAMPLE(name)                              \
  DatasetSample semfield_sample_##name(const std::string& folder); \
  DatasetSample semfield_sample_##name(const std::string& folder)

/// By dataset name; generated from the `<name>_sample.cpp` files.
const std::map<std::string, WriteSample>& dataset_samples();

}  // namespace semfield::testkit
