// How often opening a session makes each part of its network: once per device, and once more for a probe of the bounds.
#include <gtest/gtest.h>

#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "config/config_tree.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

using Counts = std::map<std::string, int>;

// Counts what a maker makes under the name of its plugin.
template <class Maker>
void count_calls(Maker& maker, const std::string& name, const std::shared_ptr<Counts>& counts) {
  if (!maker) return;
  maker = [inner = maker, name, counts](const auto&... arguments) {
    ++(*counts)[name];
    return inner(arguments...);
  };
}

// make_registry(), where each encoder, field and sampler NAME has a twin counted_NAME.
struct CountingRegistry {
  Registry registry = make_registry();
  std::shared_ptr<Counts> counts = std::make_shared<Counts>();

  CountingRegistry() {
    std::vector<PluginEntry> twins;
    for (const PluginEntry* entry : registry.entries()) {
      PluginEntry twin = *entry;
      count_calls(twin.encoder32, entry->name, counts);
      count_calls(twin.field32, entry->name, counts);
      count_calls(twin.sampler32, entry->name, counts);
      twin.name = "counted_" + entry->name;
      twins.push_back(std::move(twin));
    }
    for (PluginEntry& twin : twins) registry.add(std::move(twin));
  }

  // What opening makes of `yaml`, whose slots name twins.
  Counts opened(const std::string& yaml, bool probe = false) {
    counts->clear();
    Diagnostics diagnostics;
    SessionOptions options;
    options.probe = probe;
    RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    const Session session = open_session(std::move(config), registry, options, diagnostics);
    EXPECT_TRUE(session.pipeline);
    return *counts;
  }
};

std::string with_twins(std::string yaml, const std::vector<std::string>& names) {
  for (const std::string& name : names)
    for (std::size_t at = 0; (at = yaml.find("type: " + name, at)) != std::string::npos; at += 6)
      yaml.replace(at, 6, "type: counted_");
  return yaml;
}

TEST(Constructions, APartIsMadeOnce) {
  CountingRegistry counting;
  const Counts made =
      counting.opened(with_twins(hash_config(), {"hash_grid", "spherical_harmonics", "tiny_mlp", "occupancy_grid"}));
  EXPECT_EQ(made, (Counts{{"hash_grid", 1}, {"occupancy_grid", 1}, {"spherical_harmonics", 1}, {"tiny_mlp", 1}}));
}

TEST(Constructions, EachPassHasItsOwn) {
  CountingRegistry counting;
  const Counts made =
      counting.opened(with_twins(two_pass_config(), {"frequency", "nerf_mlp", "stratified", "importance"}));
  // Two passes; position and direction of each.
  EXPECT_EQ(made, (Counts{{"frequency", 4}, {"importance", 1}, {"nerf_mlp", 2}, {"stratified", 1}}));
}

// The probe's tables and grids are sized by the bounds that it is to replace.
TEST(Constructions, AProbeOfTheBoundsHasANetworkOfItsOwn) {
  CountingRegistry counting;
  std::string yaml = hash_config();
  yaml.replace(yaml.find("{type: analytic_room}"), 21,
               "{type: analytic_room, with_depth: false, with_labels: false, load: {probe_steps: 8}}");
  const Counts made = counting.opened(
      with_twins(std::move(yaml), {"hash_grid", "spherical_harmonics", "tiny_mlp", "occupancy_grid"}), true);
  EXPECT_EQ(made, (Counts{{"hash_grid", 2}, {"occupancy_grid", 2}, {"spherical_harmonics", 2}, {"tiny_mlp", 2}}));
}

}  // namespace
}  // namespace semfield
