// The laws of its kind for every registered encoder, field, sampler, head and loss on the CPU, and on a pretended
// device.
#include <cstdlib>
#include <set>

#include "testkit/field_bench.h"
#include "testkit/host_twin.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {
namespace {

std::string name_of(const testing::TestParamInfo<Row>& info) { return info.param.text(); }

class EncoderConformance : public testing::TestWithParam<Row> {};
TEST_P(EncoderConformance, Laws) {
  LawOptions options{.gradient_elements = 12};
  hold_for_any_accepted(linked_registry(), GetParam(), encoder_builds(Device::cpu),
                        [&](const Encoder<float>& single, const Encoder<double>& oracle, const EncoderBuild&) {
                          return encoder_laws(single, oracle, options);
                        });
}

class FieldConformance : public testing::TestWithParam<Row> {};
TEST_P(FieldConformance, Laws) {
  LawOptions options{.gradient_elements = 6};
  hold_for_any_accepted(linked_registry(), GetParam(), field_builds(linked_registry(), GetParam().name, Device::cpu),
                        [&](const Field<float>& single, const Field<double>& oracle, const FieldBuild& build) {
                          return field_laws(single, oracle, build, options);
                        });
}

class SamplerConformance : public testing::TestWithParam<Row> {};
TEST_P(SamplerConformance, Laws) {
  hold_for_any_accepted(linked_registry(), GetParam(), std::vector{sampler_build(Device::cpu)},
                        [](const Sampler<float>& single, const Sampler<double>& oracle, const SamplerBuild& build) {
                          return sampler_laws(single, oracle, build);
                        });
}

class HeadConformance : public testing::TestWithParam<Row> {};
TEST_P(HeadConformance, Laws) {
  hold_for_any_accepted(linked_registry(), GetParam(), head_builds(Device::cpu),
                        [](const Head<float>& single, const Head<double>& oracle, const HeadBuild& build) {
                          return head_laws(single, oracle, build);
                        });
}

// The head of class logits is no plugin.
TEST(HeadOfLogits, KeepsTheLaws) {
  for (const HeadBuild& build : head_builds(Device::cpu)) {
    const HeadShape shape{.feature = build.feature_dims, .hidden = 16, .width = build.width};
    const Failures failures = head_laws(OneLayerHead<float>(shape), OneLayerHead<double>(shape), build);
    EXPECT_TRUE(failures.empty()) << to_text(failures);
  }
}

class LossConformance : public testing::TestWithParam<Row> {};
TEST_P(LossConformance, Laws) {
  const Failures failures = loss_laws(linked_registry(), GetParam().name, GetParam().settings);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
}

class GroupingConformance : public testing::TestWithParam<Row> {};
TEST_P(GroupingConformance, Laws) {
  const Failures failures = grouping_laws(linked_registry(), GetParam().name, GetParam().settings);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
}

INSTANTIATE_TEST_SUITE_P(Linked, EncoderConformance, testing::ValuesIn(rows_of(PluginKind::encoder)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, FieldConformance, testing::ValuesIn(rows_of(PluginKind::field)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, SamplerConformance, testing::ValuesIn(rows_of(PluginKind::sampler)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, HeadConformance, testing::ValuesIn(rows_of(PluginKind::head)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, LossConformance, testing::ValuesIn(rows_of(PluginKind::loss)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, GroupingConformance, testing::ValuesIn(rows_of(PluginKind::grouping)), name_of);

// Zero cases, or a plugin without a row, is a failure and not a pass.
TEST(Conformance, EveryRegisteredPluginHasARow) {
  const std::vector<const PluginEntry*> entries = linked_registry().entries();
  ASSERT_FALSE(entries.empty());
  for (const PluginKind kind : kPluginKinds) {
    std::set<std::string> with_row;
    for (const Row& row : rows_of(kind)) with_row.insert(row.name);
    EXPECT_FALSE(with_row.empty()) << "no " << kind_name(kind) << " is registered";
    for (const PluginEntry* entry : entries) {
      if (entry->kind != kind) continue;
      EXPECT_TRUE(with_row.contains(entry->name)) << kind_name(kind) << " '" << entry->name << "' has no row";
    }
  }
}

TEST(Conformance, EveryDeclarationKeepsItsLaws) {
  for (const PluginEntry* entry : linked_registry().entries()) {
    const Failures failures = declaration_laws(*entry);
    EXPECT_TRUE(failures.empty()) << kind_name(entry->kind) << " '" << entry->name << "':\n" << to_text(failures);
  }
}

// Twins of components on a device, with a device whose memory is the host's: what the copies must carry, and what they
// must notice.

int g_blocks = 0;  // of the device that are not given back

std::byte* allocate(std::size_t bytes) {
  ++g_blocks;
  return static_cast<std::byte*>(std::aligned_alloc(256, (bytes + 255) / 256 * 256));
}
void release(std::byte* block) {
  --g_blocks;
  std::free(block);
}
void to_device(const void* from, std::byte* to, std::size_t bytes) { std::memcpy(to, from, bytes); }
void to_host(const std::byte* from, void* to, std::size_t bytes) { std::memcpy(to, from, bytes); }
void run(bool, const std::function<void()>& body) { body(); }

DeviceCalls pretended() { return {{Device::cuda, allocate, release}, to_device, to_host, run}; }

// Kernels of the CPU, given views of the pretended device.
class PretendedDevice : public testing::TestWithParam<Row> {
 protected:
  ~PretendedDevice() override { EXPECT_EQ(g_blocks, 0) << "blocks of the device were not given back"; }
  static LawOptions options() {
    LawOptions options;
    options.gradient_elements = 1;
    options.many_rows = 65;
    options.scratch = pretended().memory;
    return options;
  }
};

TEST_P(PretendedDevice, KeepsTheLaws) {
  const Row& row = GetParam();
  const TwinOptions twin{pretended(), false};
  if (row.kind == PluginKind::encoder) {
    hold_for_any_accepted(linked_registry(), row, encoder_builds(Device::cpu),
                          [&](const Encoder<float>& single, const Encoder<double>& oracle, const EncoderBuild&) {
                            return encoder_laws(HostEncoder(single, twin), oracle, options());
                          });
  } else if (row.kind == PluginKind::field) {
    hold_for_any_accepted(linked_registry(), row, field_builds(linked_registry(), row.name, Device::cpu),
                          [&](const Field<float>& single, const Field<double>& oracle, const FieldBuild& build) {
                            return field_laws(HostField(single, twin), oracle, build, options());
                          });
  } else {
    hold_for_any_accepted(linked_registry(), row, std::vector{sampler_build(Device::cpu)},
                          [&](const Sampler<float>& single, const Sampler<double>& oracle, const SamplerBuild& build) {
                            return sampler_laws(HostSampler(single, twin), oracle, build, options());
                          });
  }
}

std::vector<Row> first_rows() {
  std::vector<Row> rows;
  for (const PluginKind kind : {PluginKind::encoder, PluginKind::field, PluginKind::sampler}) {
    for (const Row& row : rows_of(kind)) {
      if (row.number == 0) rows.push_back(row);
    }
  }
  return rows;
}
INSTANTIATE_TEST_SUITE_P(Linked, PretendedDevice, testing::ValuesIn(first_rows()), name_of);

// y = 1, but for what it does wrong.
class Wrong final : public Encoder<float> {
 public:
  enum class Way { skips_an_element, writes_behind, writes_before, writes_its_input, writes_between_rows };
  explicit Wrong(Way way) : way_(way) {}
  EncoderTraits traits() const noexcept override { return {3, 2, Domain::metric, false}; }

 protected:
  void do_forward(const StepContext&, const Tensors<float>&, View<const double> x, View<float> y) const override {
    for (std::int64_t r = 0; r < y.rows; ++r) {
      for (std::int32_t c = 0; c < y.cols; ++c) {
        if (way_ != Way::skips_an_element || r != 1) y(r, c) = 1;
      }
    }
    if (way_ == Way::writes_behind) y.row(y.rows - 1)[y.cols] = 1;
    if (way_ == Way::writes_before) y.data[-1] = 1;
    if (way_ == Way::writes_between_rows) y.row(0)[y.cols] = 1;
    if (way_ == Way::writes_its_input) const_cast<double*>(x.data)[0] = 7;
  }
  void do_backward(const StepContext&, const Tensors<float>&, View<const double>, View<const float>,
                   View<float>) const override {}

 private:
  Way way_;
};

std::string words_of(Wrong::Way way, Guarded<float>& y) {
  const Wrong wrong(way);
  Guarded<double> x(y.rows(), 3);
  x.fill(1);
  try {
    HostEncoder(wrong, {pretended(), false}).forward({}, {}, x.view(), y.view());
  } catch (const Error& error) {
    return error.message();
  }
  return "";
}

TEST(HostTwin, AnElementThatIsLeftAloneComesBackAsItWas) {
  Guarded<float> y(3, 2, 4);
  EXPECT_EQ(words_of(Wrong::Way::skips_an_element, y), "");
  EXPECT_EQ(y.unwritten(), "element (1, 0) was not written");
  EXPECT_EQ(y.broken_guard(), "");
}

TEST(HostTwin, WhatIsWrittenBesideAViewIsSeen) {
  Guarded<float> y(3, 2, 4);
  EXPECT_EQ(words_of(Wrong::Way::writes_behind, y), "encoder.forward on the device wrote 0 bytes behind a view");
  EXPECT_EQ(words_of(Wrong::Way::writes_before, y), "encoder.forward on the device wrote 4 bytes before a view");
  EXPECT_EQ(words_of(Wrong::Way::writes_its_input, y), "encoder.forward on the device wrote into an input");
  EXPECT_EQ(words_of(Wrong::Way::writes_between_rows, y), "");
  EXPECT_EQ(y.broken_guard(), "wrote into the padding of row 0");
  EXPECT_EQ(g_blocks, 0);
}

}  // namespace
}  // namespace semfield::testkit
