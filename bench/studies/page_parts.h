// Parts of a page that a study renews, between marks; what stands around them is the writer's.
#pragma once

#include <string>

namespace semfield {

/// `text` between the lines `<!-- STUDY: PART begin -->` and `<!-- STUDY: PART end -->` of `page`, whose file is
/// `name`. Throws Error(data) where a mark is missing.
void put_part(std::string& page, const std::string& study, const std::string& part, const std::string& text,
              const std::string& name);

}  // namespace semfield
