// JSON files of poses and cameras.
#pragma once

#include <set>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/text.h"
#include "formats/input_limits.h"

namespace semfield {

/// The whole file. Throws as read_pose_file, and Error(data) for what is no JSON and for a map that has one key twice,
/// of which a parser would keep the last without a word. `Json` is a type of nlohmann-json, which no header names.
template <class Json>
Json read_pose_json(const std::string& path, const char* remedy) {
  using Event = typename Json::parse_event_t;
  std::vector<std::set<std::string>> keys;  // of the maps that are open
  std::string twice;
  const typename Json::parser_callback_t watch = [&](int, Event event, Json& parsed) {
    if (event == Event::object_start) keys.emplace_back();
    if (event == Event::object_end && !keys.empty()) keys.pop_back();
    if (event == Event::key && !keys.empty() && !keys.back().insert(parsed.template get<std::string>()).second &&
        twice.empty())
      twice = parsed.template get<std::string>();
    return true;
  };
  Json root;
  try {
    root = Json::parse(read_pose_file(path), watch);
  } catch (const typename Json::exception& e) {
    throw Error(ErrorKind::data, "scene.index.format", "'" + path + "' is not valid JSON: " + json_cause(e.what()),
                remedy);
  }
  if (!twice.empty())
    throw Error(ErrorKind::data, "scene.index.twice", "'" + path + "' has the key '" + twice + "' twice in one map",
                "keep one of the two");
  return root;
}

}  // namespace semfield
