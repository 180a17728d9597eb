#include "labels/clicks/labelling_record.h"

#include <nlohmann/json.hpp>

#include "core/error.h"

namespace semfield {

std::string labelling_record_json(const LabellingRecord& record) {
  using Json = nlohmann::ordered_json;
  Json classes = Json::array(), shown = Json::array();
  for (const LabellingRecord::Class& c : record.classes)
    classes.push_back({{"id", c.id},
                       {"name", c.name},
                       {"color", c.color},
                       {"clicks", c.clicks},
                       {"area_share", c.area_share},
                       {"confidence", c.confidence}});
  for (const LabellingRecord::Frame& f : record.shown) shown.push_back({{"frame", f.name}, {"clicks", f.clicks}});
  return Json{{"step", record.step},     {"clicks", record.clicks},       {"clicked_frames", record.clicked_frames},
              {"frames", record.frames}, {"classes", std::move(classes)}, {"shown", std::move(shown)}}
             .dump(2, ' ', false, Json::error_handler_t::replace) +
         "\n";
}

LabellingRecord parse_labelling_record(std::string_view json, const std::string& name) {
  LabellingRecord record;
  try {
    const nlohmann::json root = nlohmann::json::parse(json);
    record.step = root.at("step");
    record.clicks = root.at("clicks");
    record.clicked_frames = root.at("clicked_frames");
    record.frames = root.at("frames");
    for (const nlohmann::json& c : root.at("classes"))
      record.classes.push_back(
          {c.at("id"), c.at("name"), c.at("color"), c.at("clicks"), c.at("area_share"), c.at("confidence")});
    for (const nlohmann::json& f : root.at("shown")) record.shown.push_back({f.at("frame"), f.at("clicks")});
  } catch (const nlohmann::json::exception& e) {
    throw Error(ErrorKind::data, "run.record.damaged", "'" + name + "' cannot be read: " + e.what(),
                "delete it; the labelling page writes it again");
  }
  return record;
}

}  // namespace semfield
