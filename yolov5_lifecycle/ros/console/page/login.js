/** Says that the token was refused: the server answers a wrong one with the address /login?wrong. */

document.getElementById("refused").hidden = !new URLSearchParams(location.search).has("wrong");
