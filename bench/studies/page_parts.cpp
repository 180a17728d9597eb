#include "studies/page_parts.h"

#include "core/error.h"

namespace semfield {

namespace {

std::string mark(const std::string& study, const std::string& part, const char* edge) {
  return "<!-- " + study + ": " + part + " " + edge + " -->";
}

}  // namespace

void put_part(std::string& page, const std::string& study, const std::string& part, const std::string& text,
              const std::string& name) {
  const std::string begin = mark(study, part, "begin"), end = mark(study, part, "end");
  const std::size_t from = page.find(begin);
  const std::size_t to = from == std::string::npos ? from : page.find(end, from);
  if (to == std::string::npos) {
    throw Error(ErrorKind::data, "files.page.marks", "'" + name + "' has no place for the part '" + part + "'",
                "put the lines '" + begin + "' and '" + end + "' where it should stand");
  }
  const std::size_t at = from + begin.size();
  page.replace(at, to - at, "\n\n" + text + "\n");
}

}  // namespace semfield
