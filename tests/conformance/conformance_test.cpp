// The laws of its kind for every registered encoder, field, sampler, head and loss on the CPU, and on a pretended
// device.
#include <cstdlib>
#include <set>

#include "testkit/benches.h"
#include "testkit/host_twin.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {
namespace {

std::string name_of(const testing::TestParamInfo<Row>& info) { return info.param.text(); }

class PluginLaws : public testing::TestWithParam<Row> {};
TEST_P(PluginLaws, Hold) {
  const Row& row = GetParam();
  LawOptions options;
  if (row.kind == PluginKind::encoder) options.gradient_elements = 12;
  if (row.kind == PluginKind::field) options.gradient_elements = 6;
  hold_for_any_accepted(linked_registry(), row, [&](const auto& single, const auto& oracle, const auto& build) {
    return laws_of(single, oracle, build, options);
  });
  Failures failures;
  if (row.kind == PluginKind::loss || row.kind == PluginKind::grouping)
    failures = plugin_laws(linked_registry(), row.kind, row.name, row.settings);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
}

INSTANTIATE_TEST_SUITE_P(Linked, PluginLaws,
                         testing::ValuesIn(rows_of_kinds({PluginKind::encoder, PluginKind::field, PluginKind::sampler,
                                                          PluginKind::head, PluginKind::loss, PluginKind::grouping})),
                         name_of);

// The head of class logits is no plugin.
TEST(HeadOfLogits, KeepsTheLaws) {
  for (const HeadBuild& build : head_builds(Device::cpu)) {
    const HeadShape shape{.feature = build.feature_dims, .hidden = 16, .width = build.width};
    const Failures failures = head_laws(OneLayerHead<float>(shape), OneLayerHead<double>(shape), build);
    EXPECT_TRUE(failures.empty()) << to_text(failures);
  }
}

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
struct PretendedDevice : testing::TestWithParam<Row> {
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
  hold_for_any_accepted(linked_registry(), GetParam(), [](const auto& single, const auto& oracle, const auto& build) {
    return laws_of(*host_twin(single, {pretended(), false}), oracle, build, options());
  });
}

// The first of each encoder, field and sampler.
std::vector<Row> first_rows() {
  std::vector<Row> rows = rows_of_kinds({PluginKind::encoder, PluginKind::field, PluginKind::sampler});
  std::erase_if(rows, [](const Row& row) { return row.number > 0; });
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
    host_twin(wrong, {pretended(), false})->forward({}, {}, x.view(), y.view());
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
