#include "studies/scale_results.h"

#include <fmt/format.h>

#include <algorithm>
#include <nlohmann/json.hpp>

#include "core/error.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

std::string times_text(const std::optional<double>& value) { return value ? fmt::format("{:.2f}", *value) : "-"; }

// In the place of what is the same measurement.
template <class T, class Same>
void take(std::vector<T>& to, const T& fresh, const Same& same) {
  const auto found = std::find_if(to.begin(), to.end(), [&](const T& old) { return same(old, fresh); });
  if (found == to.end()) {
    to.push_back(fresh);
  } else {
    *found = fresh;
  }
}

}  // namespace

bool ScaleRow::operator==(const ScaleRow& o) const {
  return machine == o.machine && step == o.step && device == o.device && ranks == o.ranks && rays == o.rays &&
         seconds.median == o.seconds.median && seconds.min == o.seconds.min && seconds.max == o.seconds.max &&
         batches == o.batches && gradient_bytes == o.gradient_bytes && table_bytes == o.table_bytes;
}

const ScaleRow* ScaleResults::find(const std::string& machine, const std::string& step, int ranks,
                                   std::int64_t rays) const {
  const auto found = std::find_if(rows.begin(), rows.end(), [&](const ScaleRow& row) {
    return row.machine == machine && row.step == step && row.ranks == ranks && row.rays == rays;
  });
  return found == rows.end() ? nullptr : &*found;
}

ScaleSizes scale_sizes(const std::string& step, const std::string& device, bool quick) {
  if (quick) return {16, 32, 8};
  if (step == "paper") return device == "cuda" ? ScaleSizes{1024, 4096, 256} : ScaleSizes{256, 1024, 16};
  return device == "cuda" ? ScaleSizes{8192, 8192, 1024} : ScaleSizes{256, 1024, 64};
}

std::optional<double> measured_speedup(const ScaleResults& results, const ScaleMachine& machine,
                                       const std::string& step, int ranks, bool strong) {
  const ScaleSizes sizes = scale_sizes(step, machine.device, results.quick);
  const std::int64_t rays = strong ? sizes.strong : sizes.weak;
  const ScaleRow* one = results.find(machine.name, step, 1, rays);
  const ScaleRow* many = results.find(machine.name, step, ranks, strong ? rays : rays * ranks);
  if (one == nullptr || many == nullptr) return std::nullopt;
  return one->seconds.median / many->seconds.median * static_cast<double>(many->rays) / static_cast<double>(one->rays);
}

std::vector<std::pair<std::string, std::string>> scale_goals(const ScaleResults& results) {
  const auto times = [&](const char* step, const char* device, int ranks, bool strong) {
    std::optional<double> value;  // of the first machine that has it
    for (const ScaleMachine& machine : results.machines) {
      if (!value && machine.device == device) value = measured_speedup(results, machine, step, ranks, strong);
    }
    return times_text(value);
  };
  std::string equal = "-";
  for (const ScaleBits& bits : results.bits) {
    if (!bits.difference.empty()) equal = "no";
    if (equal == "-" && (bits.ranks > 1 || bits.threads > 1)) equal = "yes";
  }
  std::optional<double> sweep;
  if (!results.sweeps.empty()) sweep = results.sweeps.front().one_s / results.sweeps.front().two_s;
  return {{"cpu2_strong", times("paper", "cpu", 2, true)},
          {"cpu2_weak", times("paper", "cpu", 2, false)},
          {"cpu16_strong", times("paper", "cpu", 16, true)},
          {"gpu2_weak_paper", times("paper", "cuda", 2, false)},
          {"gpu2_strong_paper4096", times("paper", "cuda", 2, true)},
          {"gpu2_weak_hash", times("hash", "cuda", 2, false)},
          {"bits_equal", equal},
          {"sweep2", times_text(sweep)}};
}

std::string scale_json(const ScaleResults& results) {
  Json out{{"quick", results.quick},
           {"machines", Json::array()},
           {"rows", Json::array()},
           {"bits", Json::array()},
           {"sweeps", Json::array()}};
  for (const ScaleMachine& machine : results.machines) {
    out["machines"].push_back(
        {{"name", machine.name}, {"device", machine.device}, {"units", machine.units}, {"about", machine.about}});
  }
  for (const ScaleRow& row : results.rows) {
    out["rows"].push_back(
        {{"machine", row.machine},
         {"step", row.step},
         {"device", row.device},
         {"ranks", row.ranks},
         {"rays", row.rays},
         {"seconds", {{"median", row.seconds.median}, {"min", row.seconds.min}, {"max", row.seconds.max}}},
         {"batches", row.batches},
         {"gradient_bytes", row.gradient_bytes},
         {"table_bytes", row.table_bytes}});
  }
  for (const ScaleBits& bits : results.bits) {
    out["bits"].push_back({{"machine", bits.machine},
                           {"name", bits.name},
                           {"ranks", bits.ranks},
                           {"threads", bits.threads},
                           {"difference", bits.difference}});
  }
  for (const ScaleSweep& sweep : results.sweeps) {
    out["sweeps"].push_back({{"machine", sweep.machine},
                             {"workers", sweep.workers},
                             {"cells", sweep.cells},
                             {"one_s", sweep.one_s},
                             {"two_s", sweep.two_s}});
  }
  for (const auto& [name, value] : scale_goals(results)) out["goals"][name] = value;
  return out.dump(1) + "\n";
}

ScaleResults parse_scale_json(const std::string& text, const std::string& name) {
  ScaleResults results;
  const auto refuse = [&](const std::string& what) {
    throw Error(ErrorKind::data, "study.result.damaged", "'" + name + "' is no file of `semfield-study scale`: " + what,
                "give a results.json that `semfield-study scale --out FOLDER` has written");
  };
  try {
    const Json json = Json::parse(text);
    json.at("quick").get_to(results.quick);
    for (const Json& object : json.at("machines")) {
      ScaleMachine machine;
      object.at("name").get_to(machine.name);
      object.at("device").get_to(machine.device);
      object.at("units").get_to(machine.units);
      object.at("about").get_to(machine.about);
      results.machines.push_back(std::move(machine));
    }
    for (const Json& object : json.at("rows")) {
      ScaleRow row;
      object.at("machine").get_to(row.machine);
      object.at("step").get_to(row.step);
      object.at("device").get_to(row.device);
      object.at("ranks").get_to(row.ranks);
      object.at("rays").get_to(row.rays);
      object.at("seconds").at("median").get_to(row.seconds.median);
      object.at("seconds").at("min").get_to(row.seconds.min);
      object.at("seconds").at("max").get_to(row.seconds.max);
      object.at("batches").get_to(row.batches);
      object.at("gradient_bytes").get_to(row.gradient_bytes);
      object.at("table_bytes").get_to(row.table_bytes);
      if (!(row.seconds.min > 0) || row.rays < 1 || row.ranks < 1)
        refuse(fmt::format("a row of {} has times, rays or ranks that are not above 0", row.step));
      results.rows.push_back(std::move(row));
    }
    for (const Json& object : json.at("bits")) {
      ScaleBits bits;
      object.at("machine").get_to(bits.machine);
      object.at("name").get_to(bits.name);
      object.at("ranks").get_to(bits.ranks);
      object.at("threads").get_to(bits.threads);
      object.at("difference").get_to(bits.difference);
      results.bits.push_back(std::move(bits));
    }
    for (const Json& object : json.at("sweeps")) {
      ScaleSweep sweep;
      object.at("machine").get_to(sweep.machine);
      object.at("workers").get_to(sweep.workers);
      object.at("cells").get_to(sweep.cells);
      object.at("one_s").get_to(sweep.one_s);
      object.at("two_s").get_to(sweep.two_s);
      if (!(sweep.one_s > 0) || !(sweep.two_s > 0)) refuse("a sweep has times that are not above 0");
      results.sweeps.push_back(std::move(sweep));
    }
  } catch (const nlohmann::json::exception& e) {
    refuse(e.what());
  }
  return results;
}

ScaleResults merged(ScaleResults old, const ScaleResults& fresh) {
  if (old.machines.empty()) old.quick = fresh.quick;
  if (old.quick != fresh.quick)
    throw Error(ErrorKind::usage, "usage.flag.conflict", "figures of --quick and others do not go together",
                "measure all of them with --quick, or none");
  for (const ScaleMachine& machine : fresh.machines) {
    const bool timed = std::any_of(fresh.rows.begin(), fresh.rows.end(),
                                   [&](const ScaleRow& row) { return row.machine == machine.name; });
    const auto known = std::find_if(old.machines.begin(), old.machines.end(),
                                    [&](const ScaleMachine& m) { return m.name == machine.name; });
    if (known == old.machines.end()) {
      old.machines.push_back(machine);
    } else if (timed) {  // what is said of the machine is said of its times
      *known = machine;
    }
  }
  for (const ScaleRow& row : fresh.rows) {
    take(old.rows, row, [](const ScaleRow& a, const ScaleRow& b) {
      return a.machine == b.machine && a.step == b.step && a.device == b.device && a.ranks == b.ranks &&
             a.rays == b.rays;
    });
  }
  for (const ScaleBits& bits : fresh.bits) {
    take(old.bits, bits, [](const ScaleBits& a, const ScaleBits& b) {
      return a.machine == b.machine && a.name == b.name && a.ranks == b.ranks && a.threads == b.threads;
    });
  }
  for (const ScaleSweep& sweep : fresh.sweeps) {
    take(old.sweeps, sweep,
         [](const ScaleSweep& a, const ScaleSweep& b) { return a.machine == b.machine && a.workers == b.workers; });
  }
  return old;
}

}  // namespace semfield
