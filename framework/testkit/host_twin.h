// Components on a device that look like ones on the host: laws and numerical cases written for host memory run on them.
#pragma once

#include <memory>

#include "execution/device_library.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/head.h"
#include "plugin/sampler.h"

namespace semfield::testkit {

/// Where a twin's calls run. Each call copies its views to the device, with their strides and what stands between their
/// rows, so that an element which the kernel leaves alone comes back as it was; then whatever the call may write is
/// copied back. Throws Error(internal) when a kernel wrote into an input or beside a view. StepContext::workspace is an
/// arena of `calls.memory` (LawOptions::scratch).
struct TwinOptions {
  DeviceCalls calls;
  bool deterministic = false;
};

/// `on_device` was built for the device of `options.calls` and outlives its twin.
std::unique_ptr<Encoder<float>> host_twin(const Encoder<float>& on_device, const TwinOptions& options);
std::unique_ptr<Field<float>> host_twin(const Field<float>& on_device, const TwinOptions& options);
std::unique_ptr<Head<float>> host_twin(const Head<float>& on_device, const TwinOptions& options);
/// On a device Samples::count is the capacity; the twin gives the samples in use, as on the host. All rows of a
/// proposal's views count as its capacity. observe() is not passed on: Error(internal).
std::unique_ptr<Sampler<float>> host_twin(const Sampler<float>& on_device, const TwinOptions& options);

}  // namespace semfield::testkit
