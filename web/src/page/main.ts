document.body.append("visloc");
