// What the targets share: bytes as files in a folder of this process, several files in one input, datasets by name.
#pragma once

#include "plugin/registry.h"

namespace semfield::fuzz {

/// A folder of this process, in memory where the machine offers that; removed when the process ends.
const std::string& folder();
/// Writes `folder()/name`, making folders on the way, and returns its path.
std::string put(const std::string& name, std::string_view bytes);
/// An 8-bit grey PNG of a few pixels at `name`, written once a process.
std::string put_image(const std::string& name, int width_px = 4, int height_px = 3);

/// The input cut at its lines "=====": several files in one input. At least `count` parts, the missing ones empty.
std::vector<std::string_view> parts_of(std::string_view bytes, std::size_t count);

/// Runs `body`. An Error with a message is a refusal and gives false; Error(internal) and one without words are no
/// refusals and are passed on as std::logic_error.
bool accepted(const std::function<void()>& body);
/// Throws std::logic_error unless `holds`.
void promise(bool holds, const char* what);

/// Every linked plugin.
Registry& registry();
/// Opens the dataset `name` with the parameters `yaml` in folder(), and reads every frame when it has no errors.
void open_dataset(const std::string& name, const std::string& yaml);

}  // namespace semfield::fuzz
